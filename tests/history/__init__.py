"""Histories of servers: what was asked, what was answered, and whether the one explains the other."""
