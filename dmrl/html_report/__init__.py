"""Report a folder of outputs as one HTML page: contents, metrics and provenance.

`collect` finds recordings, datasets, models and evaluations. `report_sections` summarizes them,
`html` builds a self-contained page, and `write_report` writes the file.
"""

from dmrl.html_report.collect import Found, gather
from dmrl.html_report.report_sections import page
from dmrl.html_report.write_report import write

__all__ = ["Found", "gather", "page", "write"]
