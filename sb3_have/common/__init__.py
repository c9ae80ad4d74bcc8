"""Parts that know nothing of HAVE: encoders, fusion, evaluation, recording."""
