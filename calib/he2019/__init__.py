"""He, Sandu & Osorio (2019, Part II): their data, tables, audit and gaps."""
