"""In Chromium, from the example of an empty library to a shared page by nothing but the button for the next step."""

from studio.pages import go
from studio.test_page_next import press_next, shared_page


def test_from_the_example_to_a_shared_page_by_next_alone(visitor, tmp_path):
    person = visitor()
    tab = person.tab
    go(tab, "")
    tab.get_by_role("button", name="Try the example").click()
    person.reach("#/captures/garden")
    press_next(tab, "Start training")
    person.reach("#/runs/garden")
    assert b'class="splats"' in shared_page(person, "garden", tmp_path, 1200).read_bytes()
