"""Deployment of a trained network: int8 quantization, integer reference, ONNX and C, on arrays.

The C code is generated from ``int8.network``. ``int8.reference`` computes the same, bit for bit.
"""
