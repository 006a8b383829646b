"""What the benchmarks share: clocks, the machine, the peers' models."""
