"""Checking and repairing a data folder. Above `builds`, since a repair builds."""
