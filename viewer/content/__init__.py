"""Join the topics of a recording into what the layouts show."""
