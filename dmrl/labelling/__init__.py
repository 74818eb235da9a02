"""From a recording's logs to pairs, and from positions to labels of its images."""
