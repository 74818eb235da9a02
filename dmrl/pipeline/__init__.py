"""Pipelines of many steps, stages over folders, and the command line of stages."""
