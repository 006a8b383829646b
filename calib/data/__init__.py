"""Quantities, units, tables and the CSV files they come from."""

from __future__ import annotations

from calib.data.checks import check_enough, check_settings, check_varies, hold_out
from calib.data.files import write_table
from calib.data.reader import as_table, has_rows, read_for_model, read_table, table_from_arrays
from calib.data.table import Table

__all__ = [
    "Table", "as_table", "check_enough", "check_settings", "check_varies", "has_rows", "hold_out",
    "read_for_model", "read_table", "table_from_arrays", "write_table",
]  # fmt: skip
