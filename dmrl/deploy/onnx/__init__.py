"""Export to ONNX, float and int8, and inference with onnxruntime."""
