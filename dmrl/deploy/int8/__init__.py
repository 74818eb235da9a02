"""Post-training quantization to int8: calibration, equalisation, rounding and the reference."""
