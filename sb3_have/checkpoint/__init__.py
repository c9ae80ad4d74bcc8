"""Saving a training so that it resumes bit for bit; nothing here knows of a method, a benchmark or a picture."""
