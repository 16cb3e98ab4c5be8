"""Make the input of one training step: two views of the same points in different light, and the
teacher's outputs for these points."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float
from numpy.random import Generator

from topoloc_training.net.light import changed
from topoloc_training.net.pairs import Pair
from topoloc_training.net.slants import slanted
from topoloc_training.net.teacher import HEIGHT, WIDTH, Lessons

VIEW_WIDTH, VIEW_HEIGHT = 320, 256
NUM_POINTS = 320
_EDGE = 6  # pixels from a view's border that points keep
_NEAR = 8.0  # pixels of the source closer than this are no rivals
_TRIES = 8
_CLEAN = 0.3  # share of first views in unchanged light


@dataclass(frozen=True, eq=False)
class Sample:
    """Hold two views (2, h, w) in [0, 1], the teacher's scores under the same transforms, and the
    mask of pixels with scores to learn.

    A sample that is not taught has no teacher outputs: its points are learned from each other
    alone. Points are (2, n, 2), the teacher's descriptors of them (n, 64). Further arrays mark the
    points that lie in each view (2, n), and pairs of points that are too near each other to be
    negatives (n, n).
    """

    views: np.ndarray
    scores: np.ndarray
    inside: np.ndarray
    points: np.ndarray
    taught: np.ndarray
    valid: np.ndarray
    near: np.ndarray
    is_taught: bool = True


KnownPair = tuple[int, int, Pair]
"""A pair, and the rows of its pictures in the lessons."""


@dataclass(frozen=True)
class Shares:
    """Of samples: those that are pairs in different light, pairs of views to the sides of walls
    that were walked along both ways, and, of the other ones, those that show a picture as if it
    hung on such a wall."""

    pairs: float
    walls: float
    slants: float


def draw_sample(
    lessons: Lessons,
    pairs: list[KnownPair],
    walls: list[KnownPair],
    shares: Shares,
    generator: Generator,
) -> Sample:
    """A picture and its copy in another light, or seen from the two ends of a wall; or a pair."""
    drawn = generator.random()
    if pairs and drawn < shares.pairs:
        return _of_pair(lessons, pairs, (0.2, 0.2), generator)
    if walls and shares.pairs <= drawn < shares.pairs + shares.walls:
        of_wall = _of_pair(lessons, walls, (0.3, 0.3), generator, is_wall=True)
        of_wall.inside[:] = False
        return replace(of_wall, is_taught=False)
    index = int(generator.integers(len(lessons.paths)))
    place = _crop(generator.uniform((0.25, 0.25), (0.75, 0.75)) * (WIDTH, HEIGHT))
    other = _nudged(
        place @ _random_homography(generator, np.array([VIEW_WIDTH, VIEW_HEIGHT]) / 2, 0.8),
        generator,
    )
    is_wall = generator.random() < shares.slants
    strengths = (
        0.0 if generator.random() < _CLEAN else generator.random(),
        0.3 + 0.7 * generator.random(),
    )
    if is_wall:
        strengths = (0.4 * strengths[0], 0.4 * strengths[1])
    views, scores, inside = _seen(
        lessons, [index, index], [place, other], strengths, generator, is_wall
    )
    inside[1] = False
    points = _chosen_points(scores[0], generator)
    source = _mapped(points, place)
    return _sample(
        lessons,
        index,
        source,
        [points, _mapped(source, np.linalg.inv(other))],
        views,
        scores,
        inside,
    )


def _of_pair(
    lessons: Lessons,
    known: list[KnownPair],
    strengths: tuple[float, float],
    generator: Generator,
    is_wall: bool = False,
) -> Sample:
    """Draw points of walls at the teacher's key points, because most of a wall is bare. Draw points
    of other pairs anywhere."""
    first, second, pair = known[int(generator.integers(len(known)))]
    weights = (
        _told(lessons.scores[first], pair.day_px) + _told(lessons.scores[second], pair.other_px)
        if is_wall
        else np.ones(len(pair.day_px))
    )
    places, here, there, both = _looks(pair, weights, generator)
    for _ in range(_TRIES):
        if len(both) >= NUM_POINTS:
            break
        places, here, there, both = _looks(pair, weights, generator)
    candidates = both if len(both) else np.arange(len(here))
    shares = weights[candidates] / weights[candidates].sum()
    chosen = generator.choice(
        candidates, NUM_POINTS, replace=len(candidates) < NUM_POINTS, p=shares
    )
    views, scores, inside = _seen(lessons, [first, second], places, strengths, generator)
    return _sample(
        lessons, first, pair.day_px[chosen], [here[chosen], there[chosen]], views, scores, inside
    )


def _told(scores: np.ndarray, pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, " n"]:
    """How much of a key point the teacher sees at most within two pixels of each; a little
    anywhere."""
    x, y = np.rint(pixels).astype(int).T
    return cv2.dilate(np.asarray(scores), np.ones((5, 5), np.uint8))[y, x] / 255.0 + 0.02


def _looks(
    pair: Pair, weights: np.ndarray, generator: Generator
) -> tuple[list[np.ndarray], np.ndarray, np.ndarray, np.ndarray]:
    """Two views around the same point: their homographies, the pair's points in each, and the
    numbers of those that both see."""
    middle = int(generator.choice(len(weights), p=weights / weights.sum()))
    places = [_crop(pair.day_px[middle]), _crop(pair.other_px[middle])]
    here, there = (
        _mapped(px, np.linalg.inv(place))
        for px, place in zip((pair.day_px, pair.other_px), places, strict=True)
    )
    return places, here, there, np.flatnonzero(_within(here) & _within(there))


def _sample(
    lessons: Lessons,
    index: int,
    source: np.ndarray,
    points: list[np.ndarray],
    views: np.ndarray,
    scores: np.ndarray,
    inside: np.ndarray,
) -> Sample:
    known = (
        (source[:, 0] >= 0)
        & (source[:, 1] >= 0)
        & (source[:, 0] <= WIDTH - 1)
        & (source[:, 1] <= HEIGHT - 1)
    )
    valid = np.array([_within(view) & known for view in points])
    x, y = source.astype(np.float32).T
    near = (x[:, None] - x) ** 2 + (y[:, None] - y) ** 2 < _NEAR**2
    np.fill_diagonal(near, False)
    stacked = np.array(points, np.float32)
    return Sample(views, scores, inside, stacked, lessons.described(index, source), valid, near)


def _seen(
    lessons: Lessons,
    indices: list[int],
    places: list[np.ndarray],
    strengths: tuple[float, float],
    generator: Generator,
    is_wall: bool = False,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    size, is_ahead_right = (VIEW_WIDTH, VIEW_HEIGHT), generator.random() < 0.5 if is_wall else False
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    views, scores, inside = [], [], []
    for index, place, strength in zip(indices, places, strengths, strict=True):
        picture = cv2.warpPerspective(
            lessons.pictures[index], place, size, flags=flags, borderMode=cv2.BORDER_REFLECT_101
        )
        shown = picture.astype(np.float32) / 255
        if is_wall:
            shown, is_ahead_right = slanted(shown, is_ahead_right, generator), not is_ahead_right
        views.append(changed(shown, strength, generator))
        scores.append(
            cv2.warpPerspective(lessons.scores[index], place, size, flags=flags).astype(np.float32)
            / 255
        )
        inside.append(
            cv2.warpPerspective(
                np.ones((HEIGHT, WIDTH), np.uint8),
                place,
                size,
                flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            )
        )
    return np.array(views), np.array(scores), np.array(inside, bool)


def _crop(middle: Float[np.ndarray, "2"]) -> Float[np.ndarray, "3 3"]:
    """Whole pixels of the source: there alone are the teacher's scores exact, for they change when
    a picture is scaled or turned."""
    size = np.array([VIEW_WIDTH, VIEW_HEIGHT])
    x, y = np.clip(np.round(middle - size / 2), 0, np.array([WIDTH, HEIGHT]) - size)
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def _random_homography(
    generator: Generator, middle: Float[np.ndarray, "2"], spread: float
) -> Float[np.ndarray, "3 3"]:
    """Source pixels from a view's pixels: the view's middle comes to `middle`."""
    angle = np.deg2rad(generator.normal(0, 12)) * spread
    scale = np.exp(generator.normal(0.05, 0.3 * spread))
    cosine, sine = scale * np.cos(angle), scale * np.sin(angle)
    to_origin = np.array(
        [[1, 0, -(VIEW_WIDTH - 1) / 2], [0, 1, -(VIEW_HEIGHT - 1) / 2], [0, 0, 1.0]]
    )
    bend = generator.normal(0, 3e-4 * spread, 2)
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [bend[0], bend[1], 1]])
    return np.array([[1, 0, middle[0]], [0, 1, middle[1]], [0, 0, 1.0]]) @ turn @ to_origin


def _nudged(place: Float[np.ndarray, "3 3"], generator: Generator) -> Float[np.ndarray, "3 3"]:
    """Another look at about the same: corners of the view moved by up to a sixth of its size."""
    corners = np.array(
        [[0, 0], [VIEW_WIDTH, 0], [VIEW_WIDTH, VIEW_HEIGHT], [0, VIEW_HEIGHT]], np.float32
    )
    moved = corners + generator.uniform(-1 / 6, 1 / 6, (4, 2)) * (VIEW_WIDTH, VIEW_HEIGHT)
    return place @ cv2.getPerspectiveTransform(corners, moved.astype(np.float32))


def _chosen_points(score: np.ndarray, generator: Generator) -> Float[np.ndarray, "n 2"]:
    """Draw two thirds of the points at the teacher's key points, the rest anywhere, with fractions
    of a pixel."""
    inner = score[_EDGE:-_EDGE, _EDGE:-_EDGE]
    weight = inner.ravel().astype(np.float64) + 1e-5
    flat = generator.choice(weight.size, NUM_POINTS * 2 // 3, p=weight / weight.sum())
    rows, columns = np.divmod(flat, inner.shape[1])
    high = np.array([VIEW_WIDTH, VIEW_HEIGHT]) - _EDGE
    anywhere = generator.uniform(_EDGE, high, (NUM_POINTS - len(flat), 2))
    return np.vstack([np.column_stack([columns, rows]) + _EDGE, anywhere])


def _mapped(points: np.ndarray, homography: np.ndarray) -> np.ndarray:
    moved = np.column_stack([points, np.ones(len(points))]) @ homography.T
    return moved[:, :2] / moved[:, 2:]


def _within(points: np.ndarray) -> np.ndarray:
    low, high = _EDGE, np.array([VIEW_WIDTH, VIEW_HEIGHT]) - 1 - _EDGE
    return np.all((points >= low) & (points <= high), axis=1)
