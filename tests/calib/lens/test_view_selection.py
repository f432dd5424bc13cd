import numpy as np

from calib.board.detection import BoardView
from calib.lens.view_selection import ViewShelf


def test_the_same_pose_is_kept_once_and_sharpest(make_views, board):
    views, _ = make_views(np.random.default_rng(0), 1, noise_px=0.0)
    shelf = ViewShelf(board)
    for number, width in enumerate((3.0, 1.5, 2.0)):
        view = views[0]
        shelf.add(BoardView(str(number), view.size, view.ids, view.corners_px, width, "both"))
    assert [view.name for view in shelf.views] == ["1"]
    assert shelf.repeated == 2


def test_a_long_film_takes_no_more_room_than_a_short_one(make_views, board):
    views, _ = make_views(np.random.default_rng(1), 80)
    shelf = ViewShelf(board, capacity=12)
    for view in views:
        shelf.add(view)
        assert len(shelf.views) <= 12
    kept = np.concatenate([view.corners_px for view in shelf.views])
    seen = np.concatenate([view.corners_px for view in views])
    # Twelve of eighty views still reach nearly as far into the picture.
    assert np.abs(kept.min(0) - seen.min(0)).max() < 30
    assert np.abs(kept.max(0) - seen.max(0)).max() < 30
    order = [int(view.name.split()[1]) for view in shelf.views]
    assert order == sorted(order)


def test_sharp_views_are_preferred_to_blurred_ones_beside_them(make_views, board):
    views, _ = make_views(np.random.default_rng(2), 60)
    shelf = ViewShelf(board, capacity=20)
    for number, view in enumerate(views):
        width = 1.5 if number % 2 else 4.0
        shelf.add(BoardView(view.name, view.size, view.ids, view.corners_px, width, "both"))
    sharp = sum(view.edge_width_px < 2 for view in shelf.views)
    assert sharp >= 12  # half of all; the blurred ones that stay are the only ones of their place
