"""Fuzzers: many random cases from one seed, each of which may end in known ways only."""
