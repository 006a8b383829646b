"""The workflow of a report, its figures, page, tables and numbers."""
