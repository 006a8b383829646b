"""The report as one self-contained page, and the pages of a diagnosis and of an audit."""
