"""What a paper takes from a report: tables, a methods paragraph, references.

Everything is made from the manifest and the summary alone, so that it is made again, byte for
byte, wherever these are the same.
"""

from calib.report.publish.folder import Publication, publication

__all__ = ["Publication", "publication"]
