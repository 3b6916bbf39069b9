"""Made-up bodies, plants, pictures and sequences for experiments, benchmarks and tests, with exact truth."""
