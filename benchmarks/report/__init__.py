"""Tables, figure and text of the benchmarks, from the measurements of their parts."""
