"""What a container has at most: section 14 of docs/format.md."""

LAYERS = 1024
CHANNELS = 4096
ERRORS = 1 << 16  # channels times layers and levels
BLOCKS, PATCHES, INTERFACES = 1 << 14, 1 << 16, 1 << 16
NAMES = 1 << 16  # bytes of names of attributes, counted for each channel
EXTRAS = 1 << 22  # bytes
CODECS = 64
OPTIONAL = 256  # sections
WINDOW_ERRORS = 128  # kind of the optional section that stands there once at most
