"""Write recordings and datasets in the formats of other programs, for `dmrl convert --to`."""
