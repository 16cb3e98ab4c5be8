import numpy as np

from topoloc_worlds.rendering.light_cells import (
    FoundLight,
    LightCells,
    LightGatherer,
    divide_space,
    light_at,
)

EYES = np.array([[0.0, 0.0, 1.4], [1.0, 0.0, 1.4]])
GRID = divide_space(EYES, finest=0.05, angle=0.02)
UP, DOWN = np.array([0.0, 0.0, 1.0], np.float32), np.array([0.0, 0.0, -1.0], np.float32)


def floor_points(num: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.uniform(-2, 2, num), rng.uniform(-2, 2, num), np.zeros(num)])


def true_light(points: np.ndarray) -> np.ndarray:
    return np.column_stack(
        [1.0 + 0.2 * points[:, 0], np.ones(len(points)), 1.0 - 0.2 * points[:, 1]]
    ).astype(np.float32)


def gathered(
    light: np.ndarray, points: np.ndarray, normal: np.ndarray = UP, seed: int = 1
) -> LightCells:
    noise = np.random.default_rng(seed).exponential(1.0, (len(points), 1)).astype(np.float32)
    gatherer = LightGatherer(GRID)
    gatherer.add(
        points, np.tile(normal, (len(points), 1)), FoundLight(0.1 * light, 0.9 * light * noise)
    )
    return gatherer.cells()


def test_light_is_found_again_without_its_noise():
    points = floor_points(100_000)
    cells = gathered(true_light(points), points)
    asked = 0.9 * floor_points(500, seed=2)
    found = light_at(cells, asked, np.tile(UP, (len(asked), 1)))
    relative = np.abs(found / true_light(asked) - 1.0)
    assert np.median(relative) < 0.03
    assert relative.max() < 0.2


def test_the_two_sides_of_a_panel_have_light_of_their_own():
    points = floor_points(20_000)
    ones = np.ones((len(points), 3), np.float32)
    gatherer = LightGatherer(GRID)
    for normal, value in ((UP, 1.0), (DOWN, 0.1)):
        half = np.float32(0.5 * value) * ones
        gatherer.add(points, np.tile(normal, (len(points), 1)), FoundLight(half, half))
    cells = gatherer.cells()
    middle = np.zeros((1, 3))
    np.testing.assert_allclose(light_at(cells, middle, UP[None]), 1.0, rtol=1e-4)
    np.testing.assert_allclose(light_at(cells, middle, DOWN[None]), 0.1, rtol=1e-4)


def test_an_unsampled_spot_has_the_light_around_it():
    points = floor_points(20_000)
    outside = points[np.linalg.norm(points[:, :2], axis=1) > 0.3]
    cells = gathered(np.ones((len(outside), 3), np.float32), outside)
    np.testing.assert_allclose(light_at(cells, np.zeros((1, 3)), UP[None]), 1.0, atol=0.2)


def test_cells_grow_with_the_distance():
    far = np.column_stack([np.linspace(20, 30, 4000), np.zeros(4000), np.zeros(4000)])
    near = np.column_stack([np.linspace(0, 1, 4000), np.zeros(4000), np.zeros(4000)])
    ones = np.ones((4000, 3), np.float32)
    assert 20 <= len(gathered(ones, near).keys) < 60
    assert len(gathered(ones, far).keys) < 60  # ten times as long a line


def test_the_same_samples_give_the_same_cells():
    points = floor_points(5_000)
    first, second = (gathered(true_light(points), points) for _ in range(2))
    assert first.keys.tobytes() == second.keys.tobytes()
    assert first.light.tobytes() == second.light.tobytes()
