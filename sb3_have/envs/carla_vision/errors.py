"""What goes wrong between a client and a CARLA server."""


class CarlaConnectionError(ConnectionError):
    """There is no CARLA server, or it has gone."""
