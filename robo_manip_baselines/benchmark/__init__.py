"""The benchmark: every arm trained and evaluated on common seeds, see ``docs/benchmark.md``."""
