"""Pictures: encoded, decoded, and raw as a Bayer sensor gives them."""
