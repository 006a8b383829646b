"""The published figures and the data set reconstructed from them."""
