"""Where the source paper's own models miss: four cases from the embedded data, diagnosed."""
