"""The documentation site builds without warnings, runs its examples, and has no broken link."""

import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import pytest

from support.browser import Page as Opened
from support.browser import browser, needs_browser
from support.bundled import ROOT

BUILD_TIMEOUT_S = 900.0
"""[s] Time limit of a build on a machine that is four times slower."""
PAGES = ('index', 'getting_started', 'benchmarks', 'limitations', 'changelog', 'gallery/index',
         'guides/own_recording', 'concepts/uncertainty', 'reference/command_line',
         'reference/topics', 'reference/python/interface', 'contributing/extending')


def sphinx(builder, source, out, *options):
    """Run a Sphinx builder, with warnings as errors; return the output folder."""
    done = subprocess.run(
        [sys.executable, '-m', 'sphinx', '-W', '--keep-going', '-q', '-b', builder, *options,
         str(source), str(out)], capture_output=True, text=True, timeout=BUILD_TIMEOUT_S,
        check=False, cwd=ROOT,
        env=os.environ | {'OPENBLAS_NUM_THREADS': '1', 'ROS_DOMAIN_ID': '99'})
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-8000:]
    return out


class Page(HTMLParser):
    """Links and anchors of a page."""

    def __init__(self, text):
        super().__init__()
        self.links, self.anchors = [], set()
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        for name, value in attributes:
            if name in ('href', 'src') and value:
                self.links.append(value)
            elif name in ('id', 'name') and value:
                self.anchors.add(value)


@pytest.fixture(scope='module')
def site(tmp_path_factory):
    return sphinx('html', ROOT / 'docs', tmp_path_factory.mktemp('site') / 'html')


@pytest.mark.timeout(BUILD_TIMEOUT_S)
def test_the_site_builds_without_a_warning(site):
    assert [page for page in PAGES if not (site / f'{page}.html').is_file()] == []
    examples = {p.stem for p in (ROOT / 'examples' / 'gallery').glob('plot_*.py')}
    assert {p.stem for p in (site / 'gallery').glob('plot_*.html')} == examples
    drawn = {re.sub(r'sphx_glr_(.+)_\d+\.png', r'\1', p.name)
             for p in (site / '_images').glob('sphx_glr_*_0*.png')}
    assert examples - drawn == set()


@pytest.mark.timeout(BUILD_TIMEOUT_S)
def test_every_internal_link_leads_to_a_page_and_an_anchor(site):
    pages = {path: Page(path.read_text(encoding='utf-8')) for path in site.rglob('*.html')}
    broken, n = [], 0
    for path, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme or parts.netloc or link == '#':
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            anchor = unquote(parts.fragment)
            n += 1
            if not target.exists() or anchor and target in pages \
                    and anchor not in pages[target].anchors:
                broken.append((str(path.relative_to(site)), link))
    assert n > 1000 and broken == []


@needs_browser
@pytest.mark.timeout(BUILD_TIMEOUT_S)
def test_pages_contact_no_other_machine(site):
    with browser() as chromium:
        for name in PAGES:
            page = Opened(chromium, (site / f'{name}.html').as_uri())
            assert {urlsplit(url).scheme for url in page.requests} <= {'file', 'data'}, name
            page.page.close()


@pytest.mark.timeout(BUILD_TIMEOUT_S)
def test_examples_in_the_text_print_the_documented_output(site, tmp_path):
    """The generated pages and doctrees from the build of `site` are reused."""
    sphinx('doctest', ROOT / 'docs', tmp_path, '-d', str(site / '.doctrees'))
    text = (tmp_path / 'output.txt').read_text(encoding='utf-8')
    n, = re.findall(r'(\d+) tests?\n', text)[:1]
    assert int(n) >= 3 and ' 0 failures in tests' in text


def test_the_text_contains_no_typed_percentages():
    """Percentages are inserted from the benchmarks; typed percentages would become outdated."""
    typed = []
    for path in [ROOT / 'README.md', *(ROOT / 'docs').glob('*.md'),
                 *(ROOT / 'docs' / 'concepts').glob('*.md')]:
        if path.name in ('benchmarks.md', 'changelog.md'):
            continue
        text = re.sub(r'\{\{.*?\}\}|`[^`]*`', '', path.read_text(encoding='utf-8'), flags=re.S)
        typed += [(path.name, found) for found in re.findall(r'\d[\d.,]* %', text)
                  if found != '90 %']  # Probability of the ellipses in maps.
    assert typed == []
