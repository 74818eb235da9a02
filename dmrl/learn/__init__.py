"""Networks, training, decoding and metrics, on arrays. The only package that uses torch.

``decode_grids`` and ``detection_metrics`` use NumPy only and work without torch.
"""

import os

# torch's C++ logs lost processes; dmrl reports which one and why itself.
os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
