"""Words on pictures: headlines, paragraphs and names for whatever is printed or shown in a world.

The letters are OpenCV's own, so that no font file is needed; OpenCV 4 and 5 draw them differently.
"""

from __future__ import annotations

import cv2
import numpy as np

from topoloc_worlds.scene import Color, Picture
from topoloc_worlds.shapes import Number

_TITLES = """
Open Day; Summer School; Call for Papers; Robotics Seminar; Lab Safety; Thesis Defence; Reading Group; Lost and Found;
Choir Practice; Rooms to Let; Blood Donation; Quarterly Review; Welcome; Fire Drill; Coffee Rota; Film Night; City Marathon;
Autumn Concert; Visual Mapping; Stereo Vision; Field Trip; Bicycle Repair; Quiet Please; Workshop; Annual Report; New Horizons
"""  # noqa: E501
TITLES = tuple(title.strip() for title in _TITLES.split(";"))
_COMMON_WORDS = """
the of and to in a is for on with by from that are this at as be will or all we it an not have our new each one time may please
room use open work after before hours door week first place light camera image motion method result error point model robot lab
paper meeting student group floor key project report data system between during people office monday tuesday friday morning
evening contact keep clean clear return without under over only
"""  # noqa: E501
WORDS = tuple(_COMMON_WORDS.split())
_NAMES = """
Adler Baran Castro Dahl Eriksen Fontaine Garcia Hofer Ivanova Jensen Kato Lindqvist Moreau Nakano Okafor Petrov Quinn Rossi Sato
Tanaka Ullman Varga Weber Xu Yilmaz Zhang
"""  # noqa: E501
NAMES = tuple(_NAMES.split())
_BOOKS = """
Multiple View Geometry; Probability; Linear Algebra; Optics; Control Systems; Statistics; Mechanics; Numerical Recipes;
Real Analysis; State Estimation; Computer Vision; Topology; Signals; Compilers; Networks; Photography; Handbook of Robotics;
Materials; Electronics; Graph Theory; Thermodynamics; Operating Systems; World Atlas; Dictionary; Algorithms; Sensors;
Kalman Filters; Design Patterns
"""  # noqa: E501
BOOKS = tuple(title.strip() for title in _BOOKS.split(";"))

PAPER: Color = (0.93, 0.92, 0.89)
"""Ordinary white paper."""

# A height of 1 em in OpenCV's units: the letters of scale 1 are about this high.
_EM_PX = 30.0


def blank(size: tuple[int, int], color: Color) -> Picture:
    """A picture (height, width) of one colour."""
    return np.full((*size, 3), np.round(np.asarray(color) * 255), np.uint8)


def to_bytes(color: Color) -> tuple[int, int, int]:
    """A colour as OpenCV draws with it."""
    return (round(color[0] * 255), round(color[1] * 255), round(color[2] * 255))


def ink_on(rng: np.random.Generator, paper: Color) -> Color:
    """A colour that is readable on `paper`."""
    hue = rng.uniform(0.0, 1.0, 3)
    dark = sum(paper) > 1.4
    values = hue * 0.35 if dark else 0.7 + 0.3 * hue
    return (float(values[0]), float(values[1]), float(values[2]))


def vivid(rng: np.random.Generator) -> Color:
    """A printing ink: saturated, neither black nor white."""
    pixel = np.array(
        [[[rng.integers(0, 180), rng.integers(90, 215), rng.integers(85, 225)]]], np.uint8
    )
    red, green, blue = cv2.cvtColor(pixel, cv2.COLOR_HSV2RGB)[0, 0] / 255.0
    return (float(red), float(green), float(blue))


def write(
    picture: Picture,
    text: str,
    at: tuple[Number, Number],
    height_px: Number,
    color: Color,
    max_width_px: Number,
    bold: bool = False,
) -> float:
    """Write one line into the picture, with its base line starting at `at` (x, y). The text is
    scaled down if it is too wide.

    Returns:
        The width of the text, pixels.
    """
    font = cv2.FONT_HERSHEY_DUPLEX if bold else cv2.FONT_HERSHEY_SIMPLEX
    scale = height_px / _EM_PX
    width = cv2.getTextSize(text, font, scale, 1)[0][0]
    if width > max_width_px:
        scale *= max_width_px / width
        width = max_width_px
    thickness = max(1, round(scale * (2 if bold else 1)))
    cv2.putText(
        picture,
        text,
        (round(at[0]), round(at[1])),
        font,
        scale,
        to_bytes(color),
        thickness,
        cv2.LINE_AA,
    )
    return float(width)


def sentence(rng: np.random.Generator, num_words: int) -> str:
    """A line of ordinary words."""
    return " ".join(str(word) for word in rng.choice(WORDS, num_words))


def paragraph(
    picture: Picture,
    rng: np.random.Generator,
    area: tuple[int, int, int, int],
    line_px: Number,
    color: Color,
) -> None:
    """Fills `area` (x, y, width, height) with lines of text, ragged on the right, with an empty
    line here and there."""
    x, y, width, height = area
    num_words = max(2, int(width / (line_px * 2.0)))
    for row in range(int(height / (line_px * 1.35))):
        kind = rng.uniform()
        text = sentence(rng, num_words if kind > 0.25 else max(1, num_words // 2))
        if kind > 0.12:
            write(
                picture, text, (x, y + line_px + row * line_px * 1.35), line_px * 0.8, color, width
            )
