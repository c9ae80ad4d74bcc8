"""Networks and replay memory that several algorithms share; nothing here knows of HAVE, an environment or a file."""
