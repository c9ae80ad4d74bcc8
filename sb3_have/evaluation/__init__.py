"""Driving episodes and saying how well it went; no training, and no picture of it."""
