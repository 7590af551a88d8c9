"""Statistics of a benchmark: success and times of conditions, compared on common seeds."""
