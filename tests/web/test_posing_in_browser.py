"""The posing application under a real mouse: the shape follows the drag, in time, and undo brings every number back."""

import time

import numpy as np
import torch

MOVES = 30
# One picture of a page at 30 per second.
FRAME = 1 / 30
# Columns left of the controls.
FREE = 560


class Screen:
    """Where points of space are on a page."""

    def __init__(self, app, page):
        from viser import transforms

        while not app.server.get_clients():
            page.wait_for_timeout(100)
        client = next(iter(app.server.get_clients().values()))
        while np.linalg.norm(client.camera.position - app.server.initial_camera.position) > 1e-3:
            page.wait_for_timeout(100)  # the page still has a camera of its own
        camera = client.camera
        self._rotation = transforms.SO3(np.asarray(camera.wxyz)).as_matrix()
        self._position = np.asarray(camera.position)
        box = page.locator("canvas").first.bounding_box()  # beside the controls
        self._middle = np.array([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2])
        self._focal = box["height"] / 2 / np.tan(camera.fov / 2)

    def project(self, points):
        local = (np.asarray(points) - self._position) @ self._rotation
        return self._middle + self._focal * local[..., :2] / local[..., 2:]


def click_visible_point(app, page, screen):
    """Click where most points are, off the controls and notices, and return the new handle's number, -1 for none."""
    places = screen.project(app.editor.moved().numpy())
    left = places[(places[:, 0] < FREE) & (places[:, 1] > 170)]
    counts, columns, rows = np.histogram2d(*left.T, bins=12)
    column, row = np.unravel_index(counts.argmax(), counts.shape)
    middle = np.array([columns[column : column + 2].mean(), rows[row : row + 2].mean()])
    target = left[np.linalg.norm(left - middle, axis=-1).argmin()]
    page.mouse.click(*target)
    for _ in range(200):
        page.wait_for_timeout(100)
        if app.editor.state.vertices:
            return app.selected
    return -1


def test_a_mouse_drags_a_handle(app, record, pictures):
    page = record.page
    page.goto(app.url)
    page.wait_for_selector("canvas")
    screen = Screen(app, page)
    page.wait_for_timeout(1500)
    assert click_visible_point(app, page, screen) == 0
    page.wait_for_timeout(1500)  # the arrows are drawn
    editor = app.editor
    before, state = editor.moved(), editor.state
    start, length = editor.placed()[0].numpy(), 0.12 * editor.diagonal
    # The arrow that is longest on the page off the controls, from near its point back past its foot.
    arrows = np.eye(3) * length
    along = screen.project(start + arrows) - screen.project(start)
    off = screen.project(start + arrows)[:, 0] < FREE
    axis = (np.linalg.norm(along, axis=-1) * off).argmax()
    grip = screen.project(start + 0.8 * arrows[axis])
    direction = along[axis] / np.linalg.norm(along[axis])
    page.mouse.move(*grip)
    page.wait_for_timeout(300)
    page.mouse.down()
    for move in range(MOVES):
        page.mouse.move(*(grip - 3 * move * direction))
        time.sleep(FRAME / 2)
    page.screenshot(path=pictures / "pose_dragged.png")
    page.mouse.up()
    page.wait_for_timeout(800)
    assert app.worker.flush(timeout=10)
    solved, seconds = len(app.worker.seconds), app.worker.median_seconds
    moved = float((editor.placed()[0] - torch.from_numpy(start)).norm()) / editor.diagonal
    miss = float((editor.placed()[0] - editor.state.targets[0]).norm()) / editor.diagonal
    print(f"{solved} poses, median {1000 * seconds:.1f} ms; the handle went {moved:.1%} and misses by {miss:.3%}")
    assert moved > 0.02
    assert miss < 0.01
    assert solved > 5  # pictures keep coming
    after = editor.moved()
    assert float((after - before).norm(dim=-1).max()) > 0.02 * editor.diagonal
    page.get_by_role("button", name="Undo").click()
    page.wait_for_timeout(500)
    assert torch.equal(editor.moved(), before)
    assert torch.equal(editor.state.transforms, state.transforms)
    page.get_by_role("button", name="Redo").click()
    page.wait_for_timeout(500)
    assert torch.equal(editor.moved(), after)
    page.get_by_text("Pinned", exact=True).wait_for()
    page.screenshot(path=pictures / "pose_redone.png")
    assert record.problems(app.url) == []
