"""The road that the fake CARLA server lays out: OpenDRIVE text for the real ``carla.Map``."""

import math

#: Where road 45 begins in OpenDRIVE's axes, y to the left, and the height of all roads [m]. Aligned with no axis.
START, HEADING, HEIGHT = (50.0, -20.0), 0.5, 8.0
LENGTH, BEND_LENGTH, CURVATURE = 400.0, 300.0, 0.005
LANE_WIDTH, LANES, SHOULDER = 3.5, 4, 3.0

_HEADER = (
    '<?xml version="1.0" standalone="yes"?><OpenDRIVE><header revMajor="1" revMinor="4" name="" version="1" north="0" '
    'south="0" east="0" west="0"><geoReference><![CDATA[+proj=tmerc +lat_0=0 +lon_0=0]]></geoReference></header>'
)


def town04() -> str:
    """Road 45, straight, lanes -1 to -4 and a shoulder (-5), and its successor, road 46, a bend to the left."""
    end = START[0] + LENGTH * math.cos(HEADING), START[1] + LENGTH * math.sin(HEADING)
    straight = _road(
        45, LENGTH, START, "<line/>", '<successor elementType="road" elementId="46" contactPoint="start"/>'
    )
    arc = f'<arc curvature="{CURVATURE}"/>'
    bend = _road(46, BEND_LENGTH, end, arc, '<predecessor elementType="road" elementId="45" contactPoint="end"/>')
    return f"{_HEADER}{straight}{bend}</OpenDRIVE>"


def other_town() -> str:
    """A town with another road only."""
    return f"{_HEADER}{_road(7, 200.0, (0.0, 0.0), '<line/>', '')}</OpenDRIVE>"


def _road(number: int, length: float, start: tuple[float, float], shape: str, link: str) -> str:
    geometry = f'<geometry s="0" x="{start[0]}" y="{start[1]}" hdg="{HEADING}" length="{length}">{shape}</geometry>'
    lanes = "".join(_lane(-k, "driving", LANE_WIDTH) for k in range(1, LANES + 1))
    return (
        f'<road name="" length="{length}" id="{number}" junction="-1"><link>{link}</link>'
        f'<planView>{geometry}</planView><elevationProfile><elevation s="0" a="{HEIGHT}" b="0" c="0" d="0"/>'
        '</elevationProfile><lanes><laneSection s="0"><center><lane id="0" type="none" level="false"/></center>'
        f"<right>{lanes}{_lane(-LANES - 1, 'shoulder', SHOULDER)}</right></laneSection></lanes></road>"
    )


def _lane(number: int, kind: str, width: float) -> str:
    return (
        f'<lane id="{number}" type="{kind}" level="false"><link><predecessor id="{number}"/>'
        f'<successor id="{number}"/></link><width sOffset="0" a="{width}" b="0" c="0" d="0"/>'
        '<roadMark sOffset="0" type="broken" weight="standard" color="white" width="0.15" laneChange="both"/></lane>'
    )
