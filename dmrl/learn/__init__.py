"""Networks, training, decoding and metrics, on arrays. The only home of torch.

``decode`` and ``metrics`` are NumPy only and work without torch.
"""
