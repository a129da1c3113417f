"""In Chromium, from the example of an empty library to a shared page by nothing but the button for the next step."""

from studio.pages import go
from studio.test_page_next import next_of, press_next


def test_from_the_example_to_a_shared_page_by_next_alone(visitor, tmp_path):
    person = visitor()
    tab = person.tab
    go(tab, "")
    tab.get_by_role("button", name="Try the example").click()
    person.reach("#/captures/garden")
    press_next(tab, "Start training")
    person.reach("#/runs/garden")
    press_next(tab, "Share it", 1200)
    person.reach("#/runs/garden/share")
    press_next(tab, "Make the file")
    next_of(tab).filter(has_text="Save garden.html").wait_for()
    with tab.expect_download() as download:
        press_next(tab, "Save garden.html")
    download.value.save_as(tmp_path / "page.html")
    assert b'class="splats"' in (tmp_path / "page.html").read_bytes()
