"""Headless Chromium, for what only a browser can tell of a page."""

import shutil
import subprocess

import pytest


def browser(folder, *arguments):
    """Run headless Chromium, its console on stderr."""
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine")
    flags = ["--headless", "--no-sandbox", "--disable-background-networking", "--enable-unsafe-swiftshader"]
    flags += ["--use-gl=angle", "--use-angle=swiftshader", "--enable-logging=stderr", f"--user-data-dir={folder}"]
    done = subprocess.run([program, *flags, *arguments], capture_output=True, encoding="utf-8", check=True, timeout=120)
    assert "CONSOLE" not in done.stderr, [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    return done.stdout
