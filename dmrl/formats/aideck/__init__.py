"""Formats of the AI-deck: CPX packets, WiFi streams, HyperFlash dumps and chip outputs."""
