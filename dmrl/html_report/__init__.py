"""Report a folder of outputs as one HTML page: contents, metrics and provenance.

`collect` finds recordings, datasets, models and evaluations. `report_sections` summarizes them,
`blocks` fills them into templates as a self-contained page, and `write_report` writes the file.
"""

from dmrl.html_report.collect import ReportInputs, collect_outputs
from dmrl.html_report.report_sections import build_report
from dmrl.html_report.write_report import write_html_report

__all__ = ["ReportInputs", "build_report", "collect_outputs", "write_html_report"]
