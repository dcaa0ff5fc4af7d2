"""The data folder: records, uploads and containers that survive a power failure."""
