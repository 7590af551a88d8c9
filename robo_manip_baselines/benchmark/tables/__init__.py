"""Tables of a benchmark and their file formats."""
