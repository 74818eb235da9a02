"""A folder of outputs as one page: what is there, how good it is, where it comes from.

`gather` finds recordings, datasets, models and evaluations, `sections` says what each comes to,
`document` makes HTML of it that needs nothing else, and `write` one file.
"""

from dmrl.html_report.collect import Found, gather
from dmrl.html_report.report_sections import page
from dmrl.html_report.write_report import write

__all__ = ["Found", "gather", "page", "write"]
