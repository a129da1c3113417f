// What the page was made with: its metadata, as page.py and capture_page.py write it.

export const FACTS = JSON.parse(document.getElementById("facts").textContent);
