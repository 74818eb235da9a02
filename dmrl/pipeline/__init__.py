"""Stages in processes of their own: pipelines of many steps, and one stage over a folder."""
