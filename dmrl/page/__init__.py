"""A folder of outputs as one page: what is there, how good it is, where it comes from.

`gather` finds recordings, datasets, models and evaluations, `sections` says what each comes to,
`document` makes HTML of it that needs nothing else, and `write` one file.
"""

from dmrl.page.gather import Found, gather
from dmrl.page.sections import page
from dmrl.page.write import write

__all__ = ["Found", "gather", "page", "write"]
