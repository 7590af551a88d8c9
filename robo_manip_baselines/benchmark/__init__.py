"""The benchmark: every condition trained and evaluated on common seeds (``docs/benchmark.md``)."""
