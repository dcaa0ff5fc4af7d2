"""Tests on imitations of macOS and Windows."""
