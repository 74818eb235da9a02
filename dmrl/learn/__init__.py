"""Networks, training, decoding and metrics, on arrays. The only home of torch.

``decode`` and ``metrics`` are NumPy only and work without torch.
"""

import os

# torch's C++ reports a process that went away; which it was, and why, dmrl says itself.
os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "FATAL")
