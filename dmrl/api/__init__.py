"""dmrl from Python: recordings, datasets and models as objects, stages as functions.

Its names are those of the package: ``dmrl.open``, ``dmrl.dataset``, ``dmrl.load`` and so on.
Everything here stands on the rooms below it and adds nothing that a command cannot do.
"""
