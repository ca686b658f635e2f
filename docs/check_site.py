"""Look at every page of a built site: python check_site.py HTML_FOLDER; it ends with 1 where a link
leads nowhere.

Nothing but links that a reader clicks may point to another place: pages, scripts and pictures come
from the folder.
"""

import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote, urlsplit


class Page(HTMLParser):
    """What a page has: the names that links may point to, its links, and what it loads."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.names: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note names, links and loads of a tag."""
        of = {key: value or "" for key, value in attrs}
        self.names.update(of[key] for key in ("id", "name") if key in of)
        if tag == "a" and "href" in of:
            self.links.append(of["href"])
        elif tag == "link" and "stylesheet" in of.get("rel", ""):
            self.loads.append(of.get("href", ""))
        elif "src" in of:
            self.loads.append(of["src"])


def faults_of(site: Path) -> list[str]:
    """A line for each link or load that leads nowhere."""
    # the theme's own templates
    files = [path for path in sorted(site.rglob("*.html")) if "_static" not in path.parts]
    pages = {path: Page(path.read_text(encoding="utf-8")) for path in files}
    faults = []
    for path, page in pages.items():
        where = path.relative_to(site)
        for is_load, address in [
            *((False, link) for link in page.links),
            *((True, load) for load in page.loads),
        ]:
            parts = urlsplit(address)
            if parts.scheme == "data" or (
                parts.scheme in ("http", "https", "mailto") and not is_load
            ):
                continue
            if parts.scheme or parts.netloc:
                faults.append(f"{where}: loads {address}, which is not in the site")
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            if not target.is_file():
                faults.append(f"{where}: {address} is not there")
            elif (
                parts.fragment
                and target in pages
                and unquote(parts.fragment) not in pages[target].names
            ):
                faults.append(f"{where}: {address} has no such place on its page")
    return faults if pages else [f"{site}: no page"]


if __name__ == "__main__":
    lines = faults_of(Path(sys.argv[1]).resolve())
    print("\n".join(lines) or "every link of the site leads somewhere")
    sys.exit(bool(lines))
