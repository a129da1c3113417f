"""Photos taken in sequence are recognised, photos in other orders are not."""

import numpy as np
import pytest

from gsplat_edu.sfm.candidates import COMPARED, EXHAUSTIVE, FEW, SEQUENCE, Candidates
from gsplat_edu.sfm.pairs import all_pairs
from gsplat_edu.sfm.photos import PhotoFacts
from gsplat_edu.sfm.sequence import CHANCE, FIRST, by_chance, find_sequence, natural_order, successors_alike
from sfm.databases import random_descriptors, write_features


def described(turns):
    """Return descriptors of photos on a circle. Like VLAD, two have in common what both fields of view contain."""
    rng = np.random.default_rng(1)
    around = np.radians(np.arange(0.0, 360.0, 2.0))
    seen = np.exp(-0.5 * (np.angle(np.exp(1j * (turns[:, None] - around))) / 0.25) ** 2)
    vectors = seen @ rng.normal(size=(len(around), 400)) + rng.normal(scale=0.3, size=(len(turns), 400))
    return (vectors / np.linalg.norm(vectors, axis=1, keepdims=True)).astype(np.float32)


def laps(count, number):
    """Return the angles of photos on several laps of a circle, with uneven steps."""
    steps = np.random.default_rng(2).uniform(0.5, 1.5, count)
    return 2.0 * np.pi * number * np.cumsum(steps) / steps.sum()


def names(count):
    return [f"IMG_{i}.jpg" for i in range(count)]


def test_numbers_in_names_are_compared_as_numbers():
    files = ["IMG_10.jpg", "img_9.jpg", "IMG_100.jpg", "a2b10.png", "a2b9.png", "7.jpg"]
    assert [files[i] for i in natural_order(files)] == [
        "7.jpg",
        "a2b9.png",
        "a2b10.png",
        "img_9.jpg",
        "IMG_10.jpg",
        "IMG_100.jpg",
    ]
    padded = [f"{i:04}.jpg" for i in range(1, 40)]
    assert natural_order(padded) == list(range(39))


@pytest.mark.parametrize(("count", "number"), [(SEQUENCE, 1), (SEQUENCE, 2), (120, 1), (120, 2), (400, 3)])
def test_one_or_more_laps_are_a_sequence(count, number):
    files = sorted(names(count))  # the order in which photos are listed: IMG_1, IMG_10, IMG_100, ...
    turns = laps(count, number)[[int(name[4:-4]) for name in files]]
    found = find_sequence(files, [""] * count, described(turns))
    assert found is not None and [files[i] for i in found.order] == names(count)
    assert found.by == "name" and found.alike > max(found.by_chance, count / 2)


def test_shuffled_photos_are_no_sequence():
    rng = np.random.default_rng(3)
    vectors = described(laps(120, 2))
    most = 0
    for _ in range(10):
        order = rng.permutation(120)
        assert find_sequence(names(120), [""] * 120, vectors[order]) is None
        most = max(most, successors_alike(vectors[order]))
    assert 0 < most <= by_chance(120)


def test_times_give_the_order_if_names_do_not():
    vectors = described(laps(90, 1))
    shuffled = np.random.default_rng(4).permutation(90)
    times = [f"2024:02:12 00:{i // 60:02}:{i % 60:02}" for i in range(90)]
    found = find_sequence(names(90), [times[i] for i in shuffled], vectors[shuffled])
    assert found is not None and found.by == "EXIF time"
    np.testing.assert_array_equal(shuffled[found.order], np.arange(90))
    both = find_sequence(names(90), times, vectors)
    assert both is not None and both.by == "name, as by EXIF time"
    one_unknown = [times[i] if i else "" for i in shuffled]
    assert find_sequence(names(90), one_unknown, vectors[shuffled]) is None
    assert find_sequence(names(90), [times[0]] * 90, vectors[shuffled]) is None


def test_photos_without_features_or_of_equal_features_are_no_sequence():
    assert successors_alike(np.zeros((100, 8), np.float32)) == 0
    alike = np.zeros((100, 8), np.float32)
    alike[:, 0] = 1.0
    assert successors_alike(alike) == 0
    assert find_sequence(names(100), [""] * 100, alike) is None


def test_similarities_equal_a_plain_count():
    vectors = described(laps(300, 1))  # several blocks
    similarity = vectors @ vectors.T
    expected = 0
    for i in range(299):
        others = np.delete(np.arange(300), i)
        expected += int(np.sum(similarity[i, others] >= similarity[i, i + 1]) <= FIRST)
    assert successors_alike(vectors) == expected


def test_the_bound_on_chance_covers_random_orders():
    """For each number of similar successors, the bound is at least its frequency in random orders."""
    count, rounds = 60, 4000
    rng = np.random.default_rng(5)
    vectors = described(laps(count, 1))
    similarity = vectors @ vectors.T
    np.fill_diagonal(similarity, -np.inf)
    near = np.argsort(np.argsort(-similarity, axis=1), axis=1) < FIRST
    orders = [rng.permutation(count) for _ in range(rounds)]
    hits = np.array([near[order[:-1], order[1:]].sum() for order in orders])
    assert hits[0] == successors_alike(vectors[orders[0]])
    law = np.ones(1)
    for left in range(1, count):
        p = min(1.0, FIRST / left)
        law = np.convolve(law, (1.0 - p, p))
    bound = np.cumsum(law[::-1])[::-1]
    for least in range(1, count):
        # three standard deviations of the simulated frequency
        q = bound[least]
        assert np.mean(hits >= least) <= q + 3.0 * np.sqrt(q * (1.0 - q) / rounds) + 1.0 / rounds
    assert bound[by_chance(count)] > CHANCE >= bound[by_chance(count) + 1]
    assert by_chance(6) == 5, "so few photos prove nothing"
    assert [by_chance(n) for n in (60, 120, 1000)] == sorted(by_chance(n) for n in (60, 120, 1000))


@pytest.fixture
def lap_of(tmp_path):
    """Return a function that makes the candidate pairs of photos on a circle, from a database like COLMAP's."""

    def make(turns, places=None, **changes):
        rng = np.random.default_rng(6)
        world = random_descriptors(rng, 400)
        where, scales = rng.uniform(0.0, 2.0 * np.pi, len(world)), rng.uniform(1.0, 9.0, len(world))
        path, photos = tmp_path / f"{len(turns)}.db", {}
        for i, turn in enumerate(turns):
            seen = np.abs(np.angle(np.exp(1j * (where - turn)))) < 0.4
            photos[f"{i:06}.jpg"] = world[seen], scales[seen]
        write_features(path, photos)
        files = sorted(names(len(turns)))
        photos = [
            PhotoFacts(name, f"{i:06}.jpg", 8, 8, place=None if places is None else places[i])
            for i, name in enumerate(files)
        ]
        return Candidates(photos, path, **changes)

    return make


def turns_by_name(count, number):
    return laps(count, number)[[int(name[4:-4]) for name in sorted(names(count))]]


def test_photos_in_sequence_get_the_pairs_of_a_video_and_closed_loops(lap_of):
    found = lap_of(turns_by_name(90, 1))
    assert found.automatic() == "sequence"
    chosen, order = found.of("sequence"), natural_order(sorted(names(90)))
    assert all(a < b for a, b in chosen)
    for step in (*range(1, 11), 16, 32, 64):
        assert {(min(p), max(p)) for p in zip(order, order[step:], strict=False)} <= chosen
    first, last = order[0], order[89]
    assert (min(first, last), max(first, last)) in chosen, "the loop is closed"
    assert len(chosen) < len(all_pairs(90)) / 2
    unconnected = {5, 70}
    more = {(a, b) for a, b in all_pairs(90) if {a, b} & unconnected}
    assert found.farther("sequence", set(range(90)) - unconnected) == more, (
        "photos that do not connect are matched with all others"
    )
    assert str(found.sequence).startswith("the photos were taken in sequence: sorted by name, 8")


def test_shuffled_photos_are_matched_with_those_that_share_large_features(lap_of):
    turns = np.random.default_rng(7).permutation(laps(90, 1))
    told = []
    found = lap_of(turns, progress=lambda *step: told.append(step))
    assert found.automatic() == "likely"
    chosen, order = found.of("likely"), np.argsort(turns).tolist()
    assert {(min(p), max(p)) for p in zip(order, order[1:] + order[:1], strict=True)} <= chosen
    apart = [abs(np.angle(np.exp(1j * (turns[i] - turns[j])))) for i, j in chosen]
    assert max(apart) < 0.8, "photos that show nothing in common are not matched"
    assert len(chosen) < len(all_pairs(90)) / 3 and chosen < found.of("likely", 3)
    assert told[-1] == (len(all_pairs(90)), len(all_pairs(90)))


def test_few_photos_keep_all_pairs(lap_of):
    few = lap_of(turns_by_name(FEW, 1))
    assert few.automatic() == "exhaustive" and few.of("exhaustive") == all_pairs(FEW)
    shuffled = np.random.default_rng(7).permutation(laps(FEW + 1, 1))
    assert lap_of(shuffled).automatic() == "likely"


def test_faces_of_panoramas_keep_all_pairs(lap_of):
    assert lap_of(turns_by_name(FEW + 6, 1), unit=6).automatic() == "exhaustive"


def test_very_many_photos_without_an_order_are_paired_with_nearby_photos(lap_of):
    count = COMPARED + 1
    places = [(47.0 + 0.001 * i, 8.0, 0.0) for i in range(count)]
    found = lap_of(np.random.default_rng(8).permutation(laps(count, 1)), places)
    assert found.automatic() == "nearest"
    assert {(i, i + 1) for i in range(count - 1)} <= found.of("nearest"), (
        "positions are those of the photos' own order"
    )


def test_photos_of_a_large_set_that_do_not_connect_get_more_partners(lap_of):
    count = EXHAUSTIVE + 1
    found = lap_of(np.random.default_rng(8).permutation(laps(count, 1)))
    assert found.automatic() == "likely"
    more = found.farther("likely", range(1, count))
    assert more == {pair for pair in found.of("likely", 3) if 0 in pair} and more


def test_the_reason_for_fewer_pairs_is_reported(lap_of):
    in_order = lap_of(turns_by_name(90, 1))
    assert in_order.reason("sequence").startswith("the photos were taken in sequence: sorted by name")
    assert in_order.reason("exhaustive") == ""
    assert in_order.reason("likely").startswith("each photo is matched with those that share most")
    assert in_order.reason("nearest") == "each photo is matched with those that follow it or look alike"


def test_positions_are_a_reason_for_fewer_pairs(lap_of):
    places = [(47.0 + 0.001 * i, 8.0, 0.0) for i in range(20)]
    assert lap_of(laps(20, 1), places).reason("nearest").endswith("look alike or were taken nearby")


def test_frames_of_a_video_need_no_reason(lap_of):
    assert lap_of(laps(20, 1), video=True).reason("nearest") == ""


def test_a_chosen_matcher_follows_natural_order(lap_of):
    order = natural_order(sorted(names(20)))
    pairs = lap_of(turns_by_name(20, 1)).of("sequential")
    assert (min(order[8:10]), max(order[8:10])) in pairs
    assert len(pairs) == sum(20 - step for step in (*range(1, 11), 16))
