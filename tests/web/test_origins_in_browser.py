"""A page of another origin, open in the same browser, can neither read the posing app nor press its buttons."""

import threading
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer

import pytest

pytest.importorskip("viser", reason="the viewer needs viser")

import viser

# Tries to connect as the app's own page does, and tells how that ended; then whether it can read the page.
ATTACK = """
async ([address, page, protocol]) => {
  const ended = await new Promise((resolve) => {
    const socket = new WebSocket(address, [protocol]);
    socket.onopen = () => resolve("open");
    socket.onerror = () => resolve("refused");
  });
  const read = await fetch(page, {credentials: "include"}).then((found) => found.text(), () => "unreadable");
  return [ended, read];
}
"""


@pytest.fixture
def foreign(tmp_path):
    """The address of a page on another port of this machine, which is another origin of the same site."""
    (tmp_path / "index.html").write_text("<title>elsewhere</title>")

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *arguments):
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=tmp_path))
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()
    server.server_close()
    thread.join()


def test_only_the_own_page_gets_in(app, browser, foreign):
    context = browser.new_context()
    own = context.new_page()
    own.goto(app.url)
    own.get_by_role("button", name="Undo").wait_for(timeout=20_000)
    assert len(app.server.get_clients()) == 1
    plain = app.url.partition("?")[0]
    socket, protocol = app.url.replace("http:", "ws:"), f"viser-v{viser.__version__}"
    # In the context of the own page, so that its cookie is there to be sent.
    stranger = context.new_page()
    for place in (foreign, "data:text/html,<title>opaque</title>"):
        stranger.goto(place)
        for address in (socket, socket.partition("?")[0]):
            ended, text = stranger.evaluate(ATTACK, [address, plain, protocol])
            assert ended == "refused"
            assert text == "unreadable"
    stranger.goto(foreign)
    stranger.set_content(f'<iframe src="{app.url}" width="800" height="500"></iframe>')
    stranger.wait_for_timeout(1000)
    assert len(app.server.get_clients()) == 1  # not even in a frame, where a click could be stolen
    assert app.server.get_clients()
    context.close()


def test_a_page_that_was_opened_can_be_loaded_again(app, record):
    record.page.goto(app.url)
    record.page.get_by_role("button", name="Undo").wait_for(timeout=20_000)
    record.page.goto(app.url.partition("?")[0])  # the cookie lets in
    record.page.get_by_role("button", name="Undo").wait_for(timeout=20_000)


def test_without_the_token_the_page_says_what_to_do(app, record):
    response = record.page.goto(app.url.partition("?")[0])
    assert response.status == 403
    assert "token included" in record.page.content()
