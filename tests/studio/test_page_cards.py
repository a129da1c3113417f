"""Cards of the library: what a training takes before it starts."""

import re

from accessibility import grave_faults_in_all_styles
from gsplat_edu.data.procedural import procedural_capture
from gsplat_edu.data.writers import write_colmap
from studio.pages import waiting


def test_a_card_says_what_a_training_takes_before_it_starts(visitor, library):
    write_colmap(library[0].library.root / "captures" / "told", *procedural_capture(48, 12, splats=120))
    tab = visitor().tab
    card = tab.get_by_role("article", name="told")
    for scheme in ("light", "dark"):  # the button waits for the press that starts it
        tab.emulate_media(color_scheme=scheme)
        card.get_by_role("button", name="Next: Start training, told").click()
        card.get_by_text(
            re.compile(r"^It takes about .* of memory; [\d,]+ iterations, up to [\d,]+ splats")
        ).wait_for()
        assert card.locator(".primary").count() == 1
        assert not library[0].queue.jobs()
        if scheme == "light":
            assert grave_faults_in_all_styles(tab) == []
            card.get_by_role("button", name="Not now").click()
            assert not card.locator(".forecast").is_visible()
    with waiting(library[0]):
        card.get_by_role("button", name="Next: Start it, told").click()
        tab.wait_for_url(re.compile("#/runs/told"))
        (job,) = library[0].queue.jobs()
    assert job.work.options == {"quality": "standard"} and job.work.inputs == ("captures/told",)
