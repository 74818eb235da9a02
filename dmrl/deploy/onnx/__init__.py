"""Write ONNX files, float and int8, and run them with onnxruntime."""
