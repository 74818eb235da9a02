"""Published data sets: locanet and UWB TIERS."""
