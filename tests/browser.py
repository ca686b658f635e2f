"""Headless Chromium, for what only a browser can tell of a page."""

import re
import shutil
import subprocess

import pytest

# On a loaded machine a headless browser may never get to a frame before its own time ends; timers
# it always runs.
FRAMES = (
    "<script>window.requestAnimationFrame = (draw) => setTimeout(() => "
    "draw(performance.now()), 0)</script>"
)
BLIND = "<script>HTMLCanvasElement.prototype.getContext = () => null;</script>"  # no WebGL


def browser(folder, *arguments, is_silent=True):
    """Run headless Chromium, its console on stderr, where a silent page says nothing."""
    program = (
        shutil.which("chromium")
        or shutil.which("chromium-browser")
        or shutil.which("google-chrome")
    )
    if program is None:
        pytest.skip("no Chromium on this machine")
    flags = [
        "--headless",
        "--no-sandbox",
        "--disable-background-networking",
        "--enable-unsafe-swiftshader",
    ]
    flags += [
        "--use-gl=angle",
        "--use-angle=swiftshader",
        "--enable-logging=stderr",
        f"--user-data-dir={folder}",
    ]
    done = subprocess.run(
        [program, *flags, *arguments],
        capture_output=True,
        encoding="utf-8",
        check=True,
        timeout=120,
    )
    said = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not said or not is_silent, said
    return done.stdout


def document(page, *flags, is_silent=True):
    """The document that a browser makes of the file, after its scripts."""
    flags = (*flags, "--virtual-time-budget=60000", "--dump-dom")
    return browser(page.parent / "profile", *flags, page.as_uri(), is_silent=is_silent)


def copied(text, path, first=FRAMES, last=""):
    """The page `text` written to `path` with a script put before its own and one after, which
    its policy lets run.
    """
    text = re.sub(r"script-src [^;]*", "script-src 'unsafe-inline'", text, count=1)
    text = text.replace("<head>", "<head>" + first, 1).replace("</body>", last + "</body>")
    path.write_text(text, encoding="utf-8")
    return path
