"""Further choices of a training: behind one "More", in plain words, and as options of the command."""

import re

import pytest

from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.region import read_region, write_region
from gsplat_edu.data.writers import write_colmap
from gsplat_edu.options.offers import questions
from studio.pages import go, waiting
from waiting import resize


@pytest.fixture(scope="module")
def plain(library):
    """A capture of eight photos."""
    root = library[0].library.root
    write_colmap(root / "captures" / "choices", *procedural_capture(32, 8, splats=60))


def chosen(tab, library, choices):
    """Choose and start; return the job, which never runs."""
    tab.locator("summary", has_text="More").click()
    for label, value in choices.items():
        field = tab.get_by_label(label, exact=True)
        if field.evaluate("field => field.tagName") == "SELECT":
            field.select_option(value)
        else:
            field.fill(value)
    return started(tab, library)


def started(tab, library):
    with waiting(library[0]):
        tab.get_by_role("button", name="Start training").click()
        tab.wait_for_url(re.compile("#/runs/"))
        return library[0].queue.jobs()[-1]


def test_choices_in_words_become_options_of_the_command(visitor, library, plain):
    person = visitor()
    tab = go(person.tab, "captures/choices")
    job = chosen(
        tab,
        library,
        {
            "Brightness": "exposure",
            "Camera positions": "auto",
            "Lens": "auto",
            "What moved between the photos": "mask",
            "Sky": "none",
            "Purpose": "true",
        },
    )
    assert job.work.options == {
        "quality": "standard",
        "appearance": "exposure",
        "refine": "auto",
        "lens": "auto",
        "transients": "mask",
        "sky": "none",
        "surface": True,
    }
    words = job.command
    assert "--appearance exposure" in words and "--lens auto" in words and "--surface" in words


def test_another_recipe_takes_the_place_of_a_quality(visitor, library, plain):
    person = visitor()
    tab = go(person.tab, "captures/choices")
    job = chosen(tab, library, {"Recipe": "mcmc", "Splats at most": "500"})
    assert job.work.options == {"strategy": "mcmc", "max_gaussians": 500}


def test_without_choices_only_the_quality_is_given(visitor, library, plain):
    person = visitor()
    tab = go(person.tab, "captures/choices")
    assert chosen(tab, library, {}).work.options == {"quality": "standard"}


def test_the_page_asks_what_the_command_declares(visitor, plain):
    tab = go(visitor().tab, "captures/choices")
    tab.locator("summary", has_text="More").click()
    asked = tab.evaluate(
        """[...document.querySelectorAll("[aria-label=training] .group .grid label > *")].map(
            (field) => [field.id, field.getAttribute("aria-label"),
                        [...(field.options ?? [])].map(({ value, text }) => [value, text])])"""
    )
    assert asked == [
        [one["name"].replace("_", "-"), one["label"], list(map(list, one["words"]))]
        for group in questions("train")
        for one in group["questions"]
    ]


def test_the_box_is_chosen_while_there_is_one(visitor, library, plain):
    folder = library[0].library.root / "captures" / "choices"
    tab = go(visitor().tab, "captures/choices")
    resize(tab, 1200, 900)
    tab.locator("summary", has_text="More").click()
    box = tab.get_by_label("Learn only what is in the box")
    assert box.is_disabled() and not box.is_checked()
    tab.get_by_role("button", name="Draw the box").click()
    frame = tab.locator("iframe:not([hidden])").element_handle().content_frame()
    frame.get_by_role("button", name="save the box").click()
    tab.get_by_role("button", name="Change the box").wait_for()
    assert read_region(folder) is not None and box.is_checked()
    box.uncheck()
    job = started(tab, library)
    write_region(folder, None)
    assert job.work.options == {"quality": "standard", "set": {"region": "none"}}
    assert "region=none" in job.command


def test_the_next_step_says_how_long_the_chosen_training_takes(visitor, library, plain):
    """As the forecast of its quality does; of a number of iterations, nothing is known."""
    tab = go(visitor().tab, "captures/choices")
    forecasts = tab.locator(".forecast", has_text="of memory")
    forecasts.nth(2).wait_for()
    takes = tab.locator(".next-step .quiet")
    for number, quality in enumerate(("Draft", "Standard", "High")):
        tab.get_by_role("radio", name=quality).check()
        said = forecasts.nth(number).inner_text().partition(",")[0]
        takes.get_by_text(f"takes {said}", exact=True).wait_for()
    tab.locator("summary", has_text="More").click()
    tab.get_by_label("Iterations instead of a quality").fill("60")
    tab.get_by_label("Iterations instead of a quality").press("Tab")
    takes.wait_for(state="detached")
    assert tab.get_by_role("button", name="Next: Start training").is_visible()


def test_the_page_asks_again_while_the_studio_is_busy(visitor, plain):
    """Which is so while measurements wait that the pages of other captures have asked for."""
    person = visitor()
    refused = []

    def answer(route):
        if len(refused) == 2:
            return route.continue_()
        refused.append(route.request.url)
        return route.fulfill(
            status=503, json={"error": "forecast: too many requests are waiting; try again soon"}
        )

    person.tab.route("**/forecast*", answer)
    tab = go(person.tab, "captures/choices")
    tab.locator(".forecast", has_text="of memory").nth(2).wait_for()
    assert len(refused) == 2
