"""Settings of a short training."""

from dmrl.stages.train import Settings

SETTINGS = Settings(epochs=2, batch_size=4, device="cpu", validation_share=0.0)
