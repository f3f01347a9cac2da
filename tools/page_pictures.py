#!/usr/bin/env python3
"""Make the pictures of the live page in docs/pictures anew: ``page_pictures.py [FOLDER]``.

Measures a simulated cell for about a minute, in a ROS domain of its own, and looks at its page as
a tablet does. Needs what the tests of the page need: .venv, chromium, playwright.
"""

import re
import shutil
import signal
import subprocess
import sys
import tempfile
from contextlib import contextmanager
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

from rtest_drivers.config import config_path
from rtest_drivers.domain import free_domain

PICTURES = Path(__file__).resolve().parents[1] / 'docs' / 'pictures'
# A tablet, held across; the results need more than it shows at once [px].
SIZE = {'width': 1280, 'height': 900}
TALL = {**SIZE, 'height': 1380}
# For one thing to happen [ms]; the end of the session [s].
PATIENCE, END_S = 180_000, 60
LARGEST_BYTES = 300_000
COLOURS = 256

CONFIG = """
machine: {machine}
cycle:
  b_deg: [-75, -50, -25, 0, 25, 50, 75]
  c_deg: [0, 30, 60, 90, 120, 150, 180, 210, 240, 270, 300, 330]
  dwell_s: 0.3
nest_calibration: {{step_mm: 1.0, dwell_s: 0.3}}
spindle_runout: {{stations: 24, dwell_s: 0.3}}
setups:
  1a: {{sphere_mm: [0, -90.0, 40.6]}}
  1b: {{sphere_mm: [0, -90.0, 140.6]}}
  2b: {{sphere_mm: [0, 0, 140.6]}}
"""
# The gauges are silent for 60 simulated seconds, which are six of the watch's.
FAULTS = """
faults:
  - {kind: gauge_silent, cycle: 1a-static, pose: 72, for_s: 60}
  - {kind: pose_skipped, cycle: 1b-static, pose: 20}
  - {kind: gauge_out_of_range, cycle: 1b-static, pose: 44, gauge: 1}
"""


@contextmanager
def session(folder):
    """Address of the page of a simulated session that waits before every cycle."""
    machine = config_path('nmv1500dcg.yaml')
    config, truth = folder / 'monday.yaml', folder / 'truth.yaml'
    config.write_text(CONFIG.format(machine=machine))
    truth.write_text(config_path('cell_demo.yaml').read_text().replace(
        'machine: nmv1500dcg.yaml', f'machine: {machine}'
    ) + FAULTS)
    process = subprocess.Popen(
        [
            sys.executable, '-m', 'rtest_drivers.cli', 'session', '--config', str(config),
            '--simulate', str(truth), '--session', 'monday', '--out', str(folder / 'out'),
            '--domain', str(free_domain()), '--hold', '--view', '--port', '0',
        ],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder,
    )
    said = []
    try:
        for line in process.stdout:
            said.append(line)
            if found := re.search(r'page: (\S+)', line):
                yield found[1]
                break
        else:
            raise SystemExit('page_pictures: no page was served:\n' + ''.join(said))
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.communicate(timeout=END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.communicate()


def start(page, cycle):
    """Start the cycle that the session waits with."""
    page.wait_for_selector(f"#doing:has-text('{cycle} waits')")
    page.click('[data-wish=start]')
    page.wait_for_selector("#answer:has-text('Done')")


def measure(page, cycle):
    """Start a cycle, and wait until it is measured."""
    start(page, cycle)
    page.wait_for_selector(f"#cycles button:has-text('{cycle} ✓'), "
                           f"#cycles button:has-text('{cycle} ⚠')")


def take(page, folder, name, card):
    """Write a picture with a card at its top; returns its path."""
    header = page.evaluate("document.querySelector('header').offsetHeight")
    top = page.evaluate(f"document.querySelector('#{card}').offsetTop")
    page.evaluate(f'window.scrollTo(0, {top - header - 15})')
    # Until what has just come is drawn.
    page.wait_for_timeout(300)
    path = folder / f'page_{name}.png'
    page.screenshot(path=path)
    # The page has few colours: a third of the bytes shows the same.
    with Image.open(path) as picture:
        picture.convert('RGB').quantize(COLOURS).save(path, optimize=True)
    return path


def pictures(page, folder):
    """Walk through the session; yields the path of each picture."""
    measure(page, '1a-nest')
    measure(page, '1a-runout')
    page.wait_for_selector("#doing:has-text('1a-static waits')")
    yield take(page, folder, 'calibrated', 'gauges-card')
    start(page, '1a-static')
    page.wait_for_selector('[data-device=gauges][data-level=error]')
    yield take(page, folder, 'dead_gauges', 'gauges-card')
    page.wait_for_selector('[data-device=gauges][data-level=ok]')
    measure(page, '1b-nest')
    measure(page, '1b-static')
    start(page, '2b-nest')
    page.wait_for_selector("#doing:has-text('measuring 2b-nest')")
    page.click("#cycles button:has-text('1b-static')")
    yield take(page, folder, 'poses', 'poses-card')
    measure(page, '2b-static')
    # What the identifier says of its verdict comes after it.
    page.wait_for_selector("#gap:has-text('up to 2b-static')")
    page.wait_for_selector('#gap .badge.ok, #gap li')
    page.set_viewport_size(TALL)
    yield take(page, folder, 'results', 'picture-card')


def main(folder):
    """Make all pictures; returns the exit status."""
    chromium = shutil.which('chromium')
    if chromium is None:
        print('page_pictures: no chromium; tools/install_chromium.sh installs it', file=sys.stderr)
        return 2
    folder.mkdir(parents=True, exist_ok=True)
    status = 0
    with (
        tempfile.TemporaryDirectory() as made, session(Path(made)) as address,
        sync_playwright() as playwright,
    ):
        browser = playwright.chromium.launch(executable_path=chromium, args=['--no-sandbox'])
        page = browser.new_page(viewport=SIZE)
        page.set_default_timeout(PATIENCE)
        page.goto(address)
        for path in pictures(page, folder):
            size = path.stat().st_size
            print(f'{path}: {size / 1e3:.0f} kB', flush=True)
            if size > LARGEST_BYTES:
                print(f'page_pictures: {path.name}: larger than {LARGEST_BYTES / 1e3:.0f} kB',
                      file=sys.stderr)
                status = 1
        browser.close()
    return status


if __name__ == '__main__':
    sys.exit(main(Path(sys.argv[1]) if sys.argv[1:] else PICTURES))
