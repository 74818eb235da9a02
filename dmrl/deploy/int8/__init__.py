"""Post-training int8 quantization: calibration, equalisation, rounding, and the reference."""
