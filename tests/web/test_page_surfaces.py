"""Surfaces of all kinds: holes, closed axes, poles, several blocks, attributes; regions of the picture."""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray
from playwright.sync_api import expect

from .browser import ABOVE, Tab
from .conftest import Tabs
from .shown import Shelf, surface

# No colour of this map is as light as the background; its ends are violet and yellow.
VIRIDIS = "m=viridis"


def drawn(picture: NDArray[np.int16]) -> NDArray[np.bool_]:
    """[row, column]: where a surface covers the light background; scale, compass and legend at the bottom left out."""
    covered: NDArray[np.bool_] = picture.min(axis=2) < 0xD8
    covered[int(0.72 * len(covered)) :] = False
    return covered


def at(picture: NDArray[np.int16], x: float, y: float) -> NDArray[np.int16]:
    """Mean colour around a place."""
    row, column = int(y * picture.shape[0]), int(x * picture.shape[1])
    mean: NDArray[np.int16] = picture[row - 3 : row + 4, column - 3 : column + 4].mean(axis=(0, 1))
    return mean


def has_no_gap(covered: NDArray[np.bool_]) -> bool:
    """Whether nothing is left out between the first and the last pixel of each row: convex surfaces without cracks."""
    for row in covered:
        (found,) = np.nonzero(row)
        if len(found) and not row[found[0] : found[-1] + 1].all():
            return False
    return bool(covered.any())


def from_above(tab: Tab) -> NDArray[np.int16]:
    tab.press("Home", ABOVE)
    tab.page.mouse.move(5, 5)
    return tab.picture()


def test_holes_are_not_drawn_and_have_no_values(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("holes", VIRIDIS))
    tab.everything("m")
    picture = from_above(tab)
    assert at(picture, 0.5, 0.5).min() > 0xD8
    heights, mask = surface("holes").points, surface("holes").blocks[0].mask
    assert mask is not None
    for x, y in ((0.32, 0.5), (0.68, 0.5), (0.5, 0.22)):
        assert at(picture, x, y).min() < 0xC0
        values = tab.point(x, y)
        row, column = int(values["row"]), int(values["column"])
        assert mask[row, column]
        assert float(values["height"].removesuffix(" m")) == pytest.approx(float(heights[row, column]), rel=1e-7)
    tab.point_at_nothing(0.5, 0.5)


def test_a_torus_is_closed_both_ways(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("torus", VIRIDIS))
    tab.everything()
    picture = from_above(tab)
    covered = drawn(picture)
    rows, columns = np.nonzero(covered)
    middle = picture.shape[0] / 2, picture.shape[1] / 2
    distance = np.hypot(rows - middle[0], columns - middle[1])
    inner, outer = distance.min(), distance.max()
    assert inner / outer == pytest.approx(0.5, abs=0.06)  # radii of 2 and 4
    # Around the ring, but for the bottom of the picture, where legend and scale are, no seam is open.
    ring = (inner + outer) / 2
    for angle in np.radians(np.arange(-40, 221, 1.0)):
        row, column = middle[0] - ring * np.sin(angle), middle[1] + ring * np.cos(angle)
        assert covered[int(row), int(column)], np.degrees(angle)
    tab.point_at_nothing(0.5, 0.5)
    box = tab.canvas.bounding_box()
    assert box is not None
    values = tab.point(0.5, (middle[0] - ring) / box["height"])
    row, column = int(values["row"]), int(values["column"])
    assert float(values["z"]) == pytest.approx(float(surface("torus").points[row, column, 2]), rel=1e-6)


def test_a_map_that_goes_round_is_not_joined_across(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("round", VIRIDIS))
    tab.everything("m")
    picture = from_above(tab)
    covered = drawn(picture)
    assert has_no_gap(covered)
    # Longitudes rise from left to right, and so do heights and their colours: no sheet leads back over them.
    columns = np.flatnonzero(covered[covered.shape[0] // 2])
    left, width = columns[0] / covered.shape[1], np.ptp(columns) / covered.shape[1]
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        values = tab.point(left + share * width, 0.5)
        assert float(values["x"].split()[0]) == pytest.approx(360 * share, abs=8)
        assert float(values["height"].split()[0]) == pytest.approx(360 * share, abs=8)
    violet, yellow = (at(picture, left + share * width, 0.5) for share in (0.05, 0.9))
    assert violet[2] > violet[1] + 20
    assert yellow[1] > yellow[2] + 20


@pytest.mark.parametrize("name", ["cube-sphere", "sphere-closed", "sphere-halves", "sphere-seam"])
def test_spheres_of_any_make_have_no_cracks(tabs: Tabs, shelf: Shelf, name: str) -> None:
    tab = tabs(shelf.address(name, VIRIDIS))
    tab.everything()
    for keys in ((), ("ArrowLeft",) * 9, (ABOVE,)):
        tab.press(*keys)
        assert has_no_gap(drawn(tab.picture()))


def test_values_name_the_block(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("cube-sphere"))
    tab.everything()
    blocks = set()
    for x in (0.4, 0.5, 0.6):
        for y in (0.35, 0.5, 0.65):
            values = tab.point(x, y)
            number = int(values["block"])
            blocks.add(number)
            position = [float(values[name].split()[0]) for name in "xyz"]
            block = shelf.decoded("cube-sphere").blocks[number]
            expected = block.points[int(values["row"]), int(values["column"])]
            assert position == pytest.approx([float(value) for value in expected], rel=1e-6, abs=1e-9)
    assert len(blocks) >= 2
    assert tab.page.locator("header .facts").inner_text().startswith("6 blocks")


def test_an_attribute_colours_the_surface(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("attribute"))
    tab.everything("m")
    tab.choose("Coloured by", "temperature")
    legend = tab.view.locator(".legend")
    tab.until(lambda: legend.locator(".legend-title").inner_text() == "temperature")
    tab.until(lambda: legend.locator(".legend-ticks span").all_inner_texts()[::2] == ["0", "249"])
    picture = from_above(tab)
    left, right = at(picture, 0.3, 0.5), at(picture, 0.7, 0.5)
    assert left[2] > left[1]  # violet
    assert right[1] > right[2] + 20  # green to yellow
    values = tab.point(0.45, 0.5)
    assert float(values["temperature"]) == float(values["column"])
    tab.view.get_by_label("Colours begin at").fill("240")
    tab.view.get_by_label("Colours begin at").press("Enter")
    tab.until(lambda: legend.locator(".legend-ticks span").first.inner_text() == "240")
    again = at(from_above(tab), 0.7, 0.5)
    assert again[2] > again[1]  # all of it but the last columns is at the low end


def test_each_component_of_an_attribute_colours_the_surface(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("wind"))
    tab.everything("m")
    legend = tab.view.locator(".legend")

    def shows(name: str, most: str) -> bool:
        ticks = legend.locator(".legend-ticks span").all_inner_texts()
        return bool(legend.locator(".legend-title").inner_text() == name and ticks[::2] == ["0", most])

    for name, most in (("wind[0]", "199"), ("wind[1]", "249"), ("wind, magnitude", "319")):
        tab.choose("Coloured by", name)
        tab.until(partial(shows, name, most))


def test_a_line_of_points_is_drawn_and_read(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("line", VIRIDIS), size=(1100, 460))
    tab.everything("m")
    heights = surface("line").points.ravel()
    expect(tab.notice).to_be_empty()
    rows, columns = np.nonzero(drawn(tab.picture()))
    assert columns.max() - columns.min() > 200
    assert len(np.unique(columns)) > 0.99 * (columns.max() - columns.min())
    box = tab.canvas.bounding_box()
    assert box is not None
    middle = len(rows) // 2
    values = tab.point(columns[middle] / box["width"], rows[middle] / box["height"])
    assert values["row"] == "0"
    found = float(values["height"].removesuffix(" m"))
    assert found == pytest.approx(float(heights[int(values["column"])]), rel=1e-6)


def test_the_error_under_the_pointer_is_that_of_the_part_around_it(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("halves"))
    tab.everything("m")
    back = len(tab.moments) // 2
    tab.press("t", *["["] * back)
    largest = tab.moments[-1 - back]["max"]
    tab.until(lambda: float(tab.max.inner_text().removesuffix(" m")) == pytest.approx(largest, rel=0.01))
    tab.shown("Earlier moment")
    errors = []
    for x in (0.3, 0.8):
        tab.point(x, 0.5)
        tab.until(lambda: "errors of the 150 " in tab.values.inner_text())
        values = tab.read()
        errors.append(float(values["error at most"].removesuffix(" m")))
        assert (int(values["column"]) < 256) == (x < 0.5)
    rough, even = errors
    assert even < rough <= largest * 1.01
    tab.press("End")
    tab.shown("Complete: exact")
    tab.until(lambda: tab.read().get("error at most") == "0: exact")


def test_slope_change_lines_and_no_colours_are_drawn(tabs: Tabs, shelf: Shelf) -> None:
    tab = tabs(shelf.address("terrain", VIRIDIS))
    tab.everything("m")
    pictures = [from_above(tab)]
    legend = tab.view.locator(".legend-title")
    for name, title in (("Slope", "Slope (degrees)"), ("Last change", "Last change (m)"), ("Shading only", None)):
        tab.choose("Coloured by", name)
        if title is None:
            legend.wait_for(state="hidden")
        else:
            expect(legend).to_have_text(title)
        pictures.append(from_above(tab))
    tab.view.get_by_label("Quad lines").check()
    tab.press(*["+"] * 9)
    pictures += [tab.picture()]
    tab.press("l")
    pictures += [tab.picture()]
    for before, after in pairwise(pictures):
        assert np.abs(before - after).mean() > 1
