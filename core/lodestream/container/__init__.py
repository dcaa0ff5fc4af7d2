"""Bytes into frames and back, and the index of a complete container."""

from .frames import Frame, FrameReader, section_lengths
from .model import ByteRange, Header, Index, LayerRecord, LevelRecord, Segment
from .reader import describe, index_from, read_index, read_metadata

__all__ = [
    "ByteRange",
    "Frame",
    "FrameReader",
    "Header",
    "Index",
    "LayerRecord",
    "LevelRecord",
    "Segment",
    "describe",
    "index_from",
    "read_index",
    "read_metadata",
    "section_lengths",
]
