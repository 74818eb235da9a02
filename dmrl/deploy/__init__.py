"""From a trained network to int8: quantiser, integer reference, ONNX and C, on arrays.

``integer`` is what the C is generated from, ``reference`` is how it computes, bit for bit.
"""
