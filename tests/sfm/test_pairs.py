import numpy as np

from gsplat_edu.sfm.pairs import (
    all_pairs,
    largest_part,
    nearest_pairs,
    on_the_ground,
    photo_descriptors,
    sequential_pairs,
)


def test_all_pairs():
    assert all_pairs(4) == {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)}


def test_sequential_pairs_reach_near_and_far():
    pairs = sequential_pairs(100, 4)
    assert {j for i, j in pairs if i == 10} == {11, 12, 13, 14, 18}
    assert {j for i, j in pairs if i == 97} == {98, 99}
    assert {j for i, j in sequential_pairs(200, 8) if i == 0} == {*range(1, 9), 16, 32, 64, 128}
    assert sequential_pairs(1, 4) == set()


def test_nearest_pairs_match_brute_force():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(600, 3)) + 1e4  # several blocks of positions far from the origin
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    np.fill_diagonal(distances, np.inf)
    order = np.argsort(distances, axis=1)[:, :3]
    assert nearest_pairs(points, 3) == {(min(i, j), max(i, j)) for i in range(600) for j in order[i]}


def test_neighbours_in_the_list_can_be_skipped():
    points = np.arange(6.0)[:, None]
    assert nearest_pairs(points, 1, apart=3) == {(0, 3), (1, 4), (2, 5)}
    assert nearest_pairs(points[:2], 5, apart=3) == set()


def test_places_on_the_ground_are_metres_apart():
    # A minute of latitude is a nautical mile, 1852 m, within 0.1 % on this mean sphere.
    points = on_the_ground([(47.0, 8.0, 0.0), (47.0 + 1 / 60, 8.0, 0.0), (47.0, 8.0, 30.0), (0.0, 8.0, 0.0)])
    np.testing.assert_allclose(np.linalg.norm(points[1] - points[0]), 1852, rtol=2e-3)
    np.testing.assert_allclose(np.linalg.norm(points[2] - points[0]), 30, rtol=1e-6)
    east = on_the_ground([(60.0, 8.0, 0.0), (60.0, 8.0 + 1 / 60, 0.0)])
    np.testing.assert_allclose(np.linalg.norm(east[1] - east[0]), 1852 / 2, rtol=2e-3)


def test_the_nearest_photos_by_appearance_are_neighbours(done):
    names = [f"{i:06d}.jpg" for i in range(14)]
    described = photo_descriptors(done.out / "sfm" / "database.db", names, 0)
    np.testing.assert_allclose(np.linalg.norm(described, axis=1), 1.0, rtol=1e-5)
    np.testing.assert_array_equal(described, photo_descriptors(done.out / "sfm" / "database.db", names, 0))
    nearest = nearest_pairs(described, 2)
    # Photos are sorted by folder, so their order in the list differs from that on the circle.
    place = {name: i for i, name in enumerate(sorted(done.truth))}
    turn = {place[name]: int(name[-6:-4]) for name in done.truth}
    steps = [min((turn[i] - turn[j]) % 14, (turn[j] - turn[i]) % 14) for i, j in nearest]
    # Of all 91 pairs, 28 are at most two steps apart, so random pairs would give 31 %, with a standard deviation of
    # 11 % for so few. The limit is three standard deviations above. Neighbouring photos are 26 degrees apart.
    assert np.mean([step <= 2 for step in steps]) > 0.65


def test_a_photo_without_features_has_a_zero_descriptor(done):
    names = ["000000.jpg", "not there.jpg"]
    described = photo_descriptors(done.out / "sfm" / "database.db", names, 0)
    assert described[0].any() and not described[1].any()


def test_the_largest_connected_part():
    assert largest_part(6, [(0, 1), (2, 3), (3, 5)]) == [2, 3, 5]
    assert largest_part(3, []) == [0]
