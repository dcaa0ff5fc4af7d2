"""What keeps the C kernels safe: sanitizers, coverage, fuzzing, and the same bits from every compiler and machine."""
