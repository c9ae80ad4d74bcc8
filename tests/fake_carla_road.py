"""OpenDRIVE texts for the real ``carla.Map``."""

import math

# Start of road 45 in OpenDRIVE's axes (y to the left), its heading, and the height of all roads [m]
START, HEADING, HEIGHT = (50.0, -20.0), 0.5, 8.0
LENGTH, LANES, LANE_WIDTH = 400.0, 4, 3.5
BEND_CURVATURE = 0.005


def opendrive(*roads: str) -> str:
    """A map of roads."""
    return (
        '<?xml version="1.0" standalone="yes"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1" '
        'north="0" south="0" east="0" west="0"><geoReference><![CDATA[+proj=tmerc +lat_0=0 +lon_0=0]]></geoReference>'
        f"</header>{''.join(roads)}</OpenDRIVE>"
    )


def road(
    number: int,
    length: float,
    start: tuple[float, float] = START,
    curvature: float = 0.0,
    left: int = 0,
    link: str = "",
) -> str:
    """A road with four driving lanes and a shoulder on the right, and ``left`` driving lanes on the left."""
    shape = f'<arc curvature="{curvature}"/>' if curvature else "<line/>"
    geometry = f'<geometry s="0" x="{start[0]}" y="{start[1]}" hdg="{HEADING}" length="{length}">{shape}</geometry>'
    right = "".join(_lane(-k, "driving") for k in range(1, LANES + 1)) + _lane(-LANES - 1, "shoulder")
    return (
        f'<road name="" length="{length}" id="{number}" junction="-1"><link>{link}</link>'
        f'<planView>{geometry}</planView><elevationProfile><elevation s="0" a="{HEIGHT}" b="0" c="0" d="0"/>'
        f'</elevationProfile><lanes><laneSection s="0"><left>{"".join(_lane(k, "driving") for k in range(left, 0, -1))}'
        f'</left><center><lane id="0" type="none" level="false"/></center><right>{right}</right></laneSection></lanes>'
        "</road>"
    )


def _lane(number: int, kind: str) -> str:
    return (
        f'<lane id="{number}" type="{kind}" level="false"><link><predecessor id="{number}"/>'
        f'<successor id="{number}"/></link><width sOffset="0" a="{LANE_WIDTH}" b="0" c="0" d="0"/></lane>'
    )


def town04() -> str:
    """Road 45, which is straight, and its successor, road 46, a bend to the left."""
    end = START[0] + LENGTH * math.cos(HEADING), START[1] + LENGTH * math.sin(HEADING)
    after = '<successor elementType="road" elementId="46" contactPoint="start"/>'
    before = '<predecessor elementType="road" elementId="45" contactPoint="end"/>'
    return opendrive(road(45, LENGTH, link=after), road(46, 300.0, end, BEND_CURVATURE, link=before))


def town01() -> str:
    """A map with another road only."""
    return opendrive(road(7, 200.0))
