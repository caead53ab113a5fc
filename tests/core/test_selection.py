"""What decides which pairs become a data set: measures with known answers, and choices checked from outside."""

import itertools
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rainstereo import imagefile
from rainstereo.selection import strata
from rainstereo.selection.candidate import Candidate, Measures
from rainstereo.selection.choose import NotEnoughError, Selection, Settings, choose
from rainstereo.selection.dirt import DryDirt
from rainstereo.selection.drop_cover import drop_cover, hidden
from rainstereo.selection.edge_blur import edge_blur
from rainstereo.selection.farthest_point import farthest_points
from rainstereo.selection.keyframes import keyframes, movement, small_copy
from rainstereo.selection.measure import measure_pair
from rainstereo.selection.perceptual_hash import NEAR_DUPLICATE, from_text, nearest, perceptual_hash, to_text
from rainstereo.selection.rejection import Limits, refused
from rainstereo.selection.splits import assigned, guarded, units_of
from rainstereo.types import Array, Image


def scene(rng: np.random.Generator, width: int = 320, height: int = 240) -> Image:
    """Boxes and discs over a slope: edges, flat places, and something of every size."""
    image = np.tile(np.linspace(40, 180, height)[:, None, None], (1, width, 3)).astype(np.uint8)
    for _ in range(120):
        x, y, w, h = (int(v) for v in rng.integers((0, 0, 4, 4), (width, height, 60, 60)))
        colour = tuple(int(c) for c in rng.integers(0, 250, 3))
        cv2.rectangle(image, (x, y), (x + w, y + h), colour, -1)
    return image


def distance(a: Image, b: Image) -> int:
    """Bits, counted one by one."""
    return sum(bin(int(x) ^ int(y)).count("1") for x, y in zip(a, b, strict=True))


# -- drop cover --------------------------------------------------------------------------------------------------------


def test_cover_is_that_of_the_patches_put_on_despite_exposure_parallax_and_noise(rng: np.random.Generator) -> None:
    dry = scene(rng, 640, 480)
    strange = cv2.flip(scene(rng, 640, 480), 0)
    for wanted in (0.0, 0.1, 0.3):
        mask = np.zeros((480, 640), np.uint8)
        while mask.mean() < wanted:
            x, y = (int(v) for v in rng.integers(0, (640, 480)))
            cv2.circle(mask, (x, y), int(rng.integers(12, 40)), 1, -1)
        wet = np.where(mask[..., None] > 0, strange, np.roll(dry, 3, axis=1))
        wet = np.clip(0.85 * wet + 10 + rng.normal(0, 2, wet.shape), 0, 255).astype(np.uint8)
        assert drop_cover(wet, dry) == pytest.approx(mask.mean(), abs=0.06)
        if wanted:
            found = hidden(wet, dry)
            truth = cv2.resize(mask, found.shape[::-1], interpolation=cv2.INTER_AREA) > 0
            assert (found & truth).sum() / (
                found | truth
            ).sum() > 0.4  # a share, not an outline: flat on flat is missed


def test_cover_of_an_image_against_itself_and_of_a_flat_one_is_none(rng: np.random.Generator) -> None:
    image = scene(rng)
    assert drop_cover(image, image) == 0
    assert drop_cover(np.full_like(image, 90), np.full_like(image, 90)) == 0
    with pytest.raises(ValueError, match="expected an aligned pair"):
        drop_cover(image, image[1:])


def test_cover_of_rendered_rain_on_real_frames(shared_data: Path) -> None:
    """Against the renderer's own masks; the whole set of presets is in docs/select.md."""
    from rainstereo.apps.rain_presets import preset
    from rainstereo.apps.rain_settings import Rain

    frame = imagefile.read(sorted((shared_data / "camseq01_32class_960x720" / "images").iterdir())[3])
    frame = cv2.resize(frame, (480, 360), interpolation=cv2.INTER_AREA)
    setup = preset("drops")
    for cover in (0.05, 0.2):
        rain = Rain(replace(setup, population=setup.population.with_cover(cover)), tolerance=math.inf)
        plan = rain.renderer((480, 360)).plan(rain.drops("frame", (480, 360)))
        truth = float((plan.opacity > 0.5).mean())
        assert drop_cover(plan.apply(frame), frame) == pytest.approx(truth, abs=0.06)


# -- other measures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("blur", [1.0, 2.0, 4.0])
def test_blur_of_a_blurred_scene_is_found(rng: np.random.Generator, blur: float) -> None:
    image = scene(rng, 640, 480)[..., 1]
    assert edge_blur(image) < 0.6
    assert edge_blur(cv2.GaussianBlur(image, (0, 0), blur)) == pytest.approx(blur, rel=0.2)


def test_blur_does_not_depend_on_contrast_and_a_flat_image_has_none(rng: np.random.Generator) -> None:
    image = cv2.GaussianBlur(scene(rng)[..., 0], (0, 0), 1.5)
    assert edge_blur((0.5 * image + 40).astype(np.uint8)) == pytest.approx(edge_blur(image), abs=0.15)
    assert math.isnan(edge_blur(np.full((100, 100), 7, np.uint8)))
    assert math.isnan(edge_blur(np.zeros((6, 6), np.uint8)))


def test_movement_is_the_shift_of_a_scene(rng: np.random.Generator) -> None:
    image = cv2.GaussianBlur(scene(rng, 400, 240)[..., 0], (0, 0), 1)
    before = small_copy(image[:, 20:340])
    for shift in (0, 4, 10):
        after = small_copy(image[:, 20 + shift : 340 + shift])
        assert movement(before, after) == pytest.approx(shift / 320, abs=0.002)


def test_key_frames_come_with_movement_and_none_while_it_stands() -> None:
    moved = np.array([np.nan, 0.02, 0.02, 0.02, 0, 0, 0, 0.03, 0.03, np.nan, 0.01])
    found = keyframes(moved, 0.05, 0.001)
    assert np.flatnonzero(found.key).tolist() == [0, 3, 8, 9]
    assert np.flatnonzero(found.still).tolist() == [4, 5, 6]
    assert keyframes(moved, 0.0, 0.0).key.all()
    with pytest.raises(ValueError, match="expected 0 or more"):
        keyframes(moved, -1, 0)


def test_dirt_on_the_dry_side_is_told_from_drops_on_the_wet_one(rng: np.random.Generator) -> None:
    road = scene(rng, 900, 240)
    stain = np.zeros((240, 320), np.uint8)
    cv2.circle(stain, (200, 90), 22, 1, -1)
    texture = cv2.flip(scene(rng), 1)
    shares = {}
    for side in ("wet", "dry", "neither"):
        sums = DryDirt()
        for i in range(12):
            clear = road[:, 20 * i : 20 * i + 320]
            covered = np.where(stain[..., None] > 0, texture, clear)
            sums.add(covered if side == "wet" else clear, covered if side == "dry" else clear)
        shares[side] = sums.share
    assert shares["wet"] == shares["neither"] == 0
    assert Limits().dirt < shares["dry"] < 1.2 * stain.mean()  # its rim, and what of it is not crossed by edges
    assert math.isnan(DryDirt().share)


def test_measures_of_a_pair(rng: np.random.Generator) -> None:
    dry = scene(rng)
    dry[:60] = 255
    found, where, small = measure_pair(dry, dry)
    gray = cv2.cvtColor(dry, cv2.COLOR_BGR2GRAY)
    assert found.brightness == pytest.approx(gray.mean())
    assert found.clipped == pytest.approx((gray >= 250).mean())
    assert found.dark == pytest.approx((gray <= 8).mean())
    assert (where.shape, small.shape) == ((240, 320), (120, 160))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"problem": "zero bytes"}, "incomplete"), ({"brightness": 5.0}, "dark"), ({"dark": 0.9}, "dark"),
        ({"clipped": 0.5}, "clipped"), ({"blur_px": 4.0}, "blurred"), ({"dirt": 0.02}, "dirty"), ({}, None),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_told_by_its_reason(change: dict[str, object], reason: str | None) -> None:
    pair = Candidate("a", None, None, "d", 0.0)
    good = Measures("", 100.0, 0.0, 0.0, 1.0, 0.1, 0.02, 0.0, "00" * 32)
    found = refused(pair, replace(good, **change), Limits())  # type: ignore[arg-type]
    assert (found[0] if found else None) == reason
    assert refused(replace(pair, sync_us=-2000.0), good, Limits()) == ("out of sync", "-2000 us")


# -- hashes ------------------------------------------------------------------------------------------------------------


def test_hash_forgives_exposure_noise_and_size_and_not_another_scene(rng: np.random.Generator) -> None:
    image = scene(rng, 640, 480)[..., 1]
    other = scene(rng, 640, 480)[..., 1]
    own = perceptual_hash(image)
    noisy = np.clip(0.8 * image + 5 + rng.normal(0, 3, image.shape), 0, 255).astype(np.uint8)
    assert distance(own, perceptual_hash(noisy)) <= 8
    assert distance(own, perceptual_hash(cv2.resize(image, (320, 240), interpolation=cv2.INTER_AREA))) <= 8
    assert distance(own, perceptual_hash(other)) > NEAR_DUPLICATE + 20
    assert (from_text(to_text(own)) == own).all()
    with pytest.raises(ValueError, match="64 hexadecimal digits"):
        from_text("12zz")


def test_near_duplicates_are_consecutive_frames_and_no_other_places(shared_data: Path) -> None:
    """The threshold lies between frames 1/15 s apart and frames of other places."""
    drive = [imagefile.read(p, gray=True) for p in sorted((shared_data / "camseq01_32class_960x720/images").iterdir())]
    hashes = np.array([perceptual_hash(image) for image in drive])
    assert max(distance(a, b) for a, b in itertools.pairwise(hashes)) <= NEAR_DUPLICATE - 10
    places = sorted((shared_data / "camvid11_480x360/train").iterdir())
    few = np.array([perceptual_hash(imagefile.read(p, gray=True)) for p in (places[0], places[75], places[149])])
    apart = [distance(few[i], few[j]) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert min(apart) > NEAR_DUPLICATE + 30


@given(st.integers(0, 2**32 - 1), st.integers(1, 30), st.integers(0, 8))
@settings(max_examples=25, deadline=None)
def test_nearest_and_farthest_agree_with_counting_bits(seed: int, count: int, others: int) -> None:
    rng = np.random.default_rng(seed)
    hashes = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    before = rng.integers(0, 256, (others, 32), dtype=np.uint8)
    which, bits = nearest(hashes, before)
    for i in range(count if others else 0):
        all_ = [distance(hashes[i], b) for b in before]
        assert bits[i] == min(all_) == all_[which[i]]
    take = (count + 1) // 2
    rows, gaps = farthest_points(hashes, take, seed, before)
    assert len(set(rows.tolist())) == take
    have = list(before)
    for row, gap in zip(rows, gaps, strict=True):
        reach = [min((distance(h, c) for c in have), default=math.inf) for h in hashes]
        assert gap == reach[row]
        left = [reach[i] for i in range(count) if not any(hashes[i] is h for h in have) and i not in {*rows[:0]}]
        assert gap == max(left)
        have.append(hashes[row])


def test_farthest_points_refuse_more_than_there_are() -> None:
    with pytest.raises(ValueError, match="3 of 2"):
        farthest_points(np.zeros((2, 32), np.uint8), 3, 0)


# -- strata and splits -------------------------------------------------------------------------------------------------


@given(st.dictionaries(st.integers(), st.integers(0, 50), min_size=1, max_size=8), st.floats(0, 1), st.data())
@settings(max_examples=60, deadline=None)
def test_shares_are_exact_and_never_more_than_there_is(
    sizes: dict[int, int], balance: float, data: st.DataObject
) -> None:
    count = data.draw(st.integers(0, sum(sizes.values())))
    shares = strata.shared_out(sizes, count, balance)
    assert sum(shares.values()) == count
    assert all(0 <= shares[key] <= size for key, size in sizes.items())
    for a in sizes:
        for b in sizes:
            if sizes[a] >= sizes[b]:
                assert shares[a] >= shares[b] - 1  # a larger stratum gives no less, but for rounding


def test_balance_is_between_the_recording_s_shares_and_all_alike() -> None:
    sizes = {"much": 900, "little": 100}
    assert strata.shared_out(sizes, 100, 0.0) == {"much": 90, "little": 10}
    assert strata.shared_out(sizes, 100, 0.5) == {"much": 75, "little": 25}
    assert strata.shared_out(sizes, 100, 1.0) == {"much": 50, "little": 50}
    assert strata.shared_out({"much": 900, "little": 20}, 100, 1.0) == {"much": 80, "little": 20}
    assert [strata.bin_of(v, (0.1, 0.5)) for v in (0.0, 0.1, 0.5, math.nan)] == ["<0.1", "0.1-0.5", ">=0.5", "?"]


def test_blocks_are_long_enough_and_guards_keep_splits_apart(rng: np.random.Generator) -> None:
    drives = ["a"] * 400 + ["b"] * 90
    times = np.concatenate([np.sort(rng.uniform(0, 200, 400)), np.sort(rng.uniform(1000, 1020, 90))])
    units = units_of(drives, times, 30.0)
    assert (units.end - units.start)[:-1].min() >= 30
    assert Counter(units.drive) == {"a": 6, "b": 1}
    splits = assigned(np.bincount(units.unit).tolist(), {"test": 80, "val": 40}, 3)
    assert set(splits) == {"train", "val", "test"}
    left = ~guarded(units, splits, times, 10.0)
    label = np.array(splits, dtype=object)[units.unit]
    for a in np.flatnonzero(left):
        for b in np.flatnonzero(left & (label != label[a])):
            assert drives[a] != drives[b] or abs(times[a] - times[b]) >= 10.0 - 1e-9


# -- the whole choice --------------------------------------------------------------------------------------------------


def walk(rng: np.random.Generator, length: int, flips: int = 6) -> Array:
    """Hashes of a drive: a few bits change from one to the next."""
    bits = rng.integers(0, 2, 256, dtype=np.uint8)
    rows = []
    for _ in range(length):
        bits = bits.copy()
        bits[rng.integers(0, 256, flips)] ^= 1
        rows.append(np.packbits(bits))
    return np.array(rows)


def recording(seed: int, drives: int, length: int, period: float = 0.5) -> tuple[list[Candidate], list[Measures]]:
    rng = np.random.default_rng(seed)
    pairs, found = [], []
    for d in range(drives):
        for i, row in enumerate(walk(rng, length)):
            regime = ("mist", "drops")[i // 20 % 2]
            pairs.append(Candidate(f"{d}_{i}", Path("x"), Path("y"), f"drive {d}", i * period, i, regime))
            moved = math.nan if i == 0 else float(rng.choice([0.0, 0.02, 0.06]))
            found.append(Measures("", float(rng.uniform(10, 200)), 0.0, 0.0, 1.0, float(rng.uniform(0, 0.6)), moved,
                                  0.0, to_text(row)))  # fmt: skip
    return pairs, found


def check(pairs: list[Candidate], found: list[Measures], selection: Selection, wanted: Settings) -> None:
    """Everything that is promised, counted from outside."""
    rows = selection.rows.tolist()
    assert len(set(rows)) == len(rows) == (wanted.count or len(rows))
    assert set(rows).isdisjoint(selection.rejected)
    assert len(rows) + len(selection.rejected) == len(pairs)
    hashes = np.array([from_text(found[i].hash) for i in rows])
    labels = np.array(selection.split)
    least = math.inf
    for a in range(len(rows)):
        for b in np.flatnonzero(labels != labels[a]):
            least = min(least, distance(hashes[a], hashes[b]))
            first, second = pairs[rows[a]], pairs[rows[int(b)]]
            assert first.drive != second.drive or abs(first.time - second.time) >= wanted.guard
            assert selection.split_by != "drive" or first.drive != second.drive
    assert least > wanted.near
    assert selection.nearest_across == least
    assert int(selection.reserved.sum()) == wanted.reserve
    assert set(labels[selection.reserved]) <= {"test"}


@pytest.mark.parametrize(("drives", "way"), [(8, "drive"), (1, "block")])
def test_exactly_as_many_and_no_moment_in_two_splits(drives: int, way: str) -> None:
    pairs, found = recording(1, drives, 900 // drives)
    wanted = Settings(count=120, seed=5, reserve=20)
    selection = choose(pairs, found, wanted)
    assert selection.split_by == way
    assert Counter(selection.split) == {"train": 88, "val": 12, "test": 20}
    check(pairs, found, selection, wanted)
    again, other = choose(pairs, found, wanted), choose(pairs, found, replace(wanted, seed=6))
    assert again.rows.tolist() == selection.rows.tolist()
    assert again.split == selection.split
    assert other.rows.tolist() != selection.rows.tolist()


def test_a_place_seen_again_in_another_drive_does_not_leak() -> None:
    """The second half of the drives repeats the first half, nearly: by time alone nobody would notice."""
    pairs, found = recording(2, 6, 150)
    again = [replace(p, drive=f"again {p.drive}", name=f"again {p.name}") for p in pairs]
    wanted = Settings(count=100, seed=1, split_by="drive")
    selection = choose(pairs + again, found + found, wanted)
    check(pairs + again, found + found, selection, wanted)
    assert Counter(reason for reason, _ in selection.rejected.values())["leak"] > 0


def test_without_a_count_all_that_survive_are_taken() -> None:
    pairs, found = recording(3, 5, 100)
    selection = choose(pairs, found, Settings(seed=1))
    assert not {reason for reason, _ in selection.rejected.values()} & {"surplus"}
    check(pairs, found, selection, Settings(seed=1))


def test_too_few_say_so_with_the_reasons() -> None:
    pairs, found = recording(4, 3, 60)
    found = [replace(each, blur_px=9.0) if i % 2 else each for i, each in enumerate(found)]
    with pytest.raises(NotEnoughError, match="170 pairs were asked for") as caught:
        choose(pairs, found, Settings(count=170))
    assert "87 blurred" in str(caught.value)
    assert len(caught.value.rejected) >= 90
    with pytest.raises(NotEnoughError, match="record more drives"):
        choose(pairs[:60], found[:60], Settings(count=12, split_by="drive"))


def test_equal_timestamps_are_rejected() -> None:
    pairs, found = recording(5, 4, 80)
    pairs[7] = replace(pairs[7], timestamp_us=pairs[6].timestamp_us)
    assert choose(pairs, found, Settings(seed=0)).rejected[7] == ("duplicate", "timestamp 6")


@pytest.mark.parametrize(
    "bad", [{"count": 0}, {"val": 0.6, "test": 0.5}, {"reserve": 9, "count": 3}, {"split_by": "luck"}]
)
def test_settings_that_make_no_sense_are_refused(bad: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"expected|asked for"):
        Settings(**bad)  # type: ignore[arg-type]
