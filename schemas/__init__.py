"""Message definitions (dmrl/v1/*.proto) and the descriptor set built from them."""
