"""Batch least squares: residuals, robust loss, linear algebra and covariance."""
