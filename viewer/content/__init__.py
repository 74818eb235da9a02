"""Join the topics of a recording into the data of the layouts."""
