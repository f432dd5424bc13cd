"""Coarse masks of a film without poses."""

import cv2
import numpy as np

from relight.masks import rough_foreground


def overlap(mask, truth):
    small = cv2.resize(truth, mask.shape[::-1], interpolation=cv2.INTER_AREA) > 0.5
    found = mask > 127
    return np.count_nonzero(found & small) / np.count_nonzero(found | small)


def test_what_the_flash_brightens_is_found_in_lit_and_unlit_frames(film):
    masks = rough_foreground(film.session, film.session.frames)
    assert sorted(masks) == sorted(film.truth)
    for index, mask in masks.items():
        assert mask.dtype == np.uint8
        assert mask.shape == (32, 32)
        # Of 32 x 32 pixels some 310 are covered; those on the outline, 100, decide by half.
        assert overlap(mask, film.truth[index]) > 0.75


def test_frames_of_one_kind_alone_give_no_mask(film):
    unlit = [record for record in film.session.frames if record.flash == 0]
    lit = [record for record in film.session.frames if record.flash == 1]
    assert rough_foreground(film.session, unlit) == {}
    assert rough_foreground(film.session, lit) == {}
    assert rough_foreground(film.session, []) == {}


def test_a_light_that_brightens_all_alike_gives_no_mask(tmp_path):
    from capture.images import write_png
    from capture.session import FrameRecord, Session

    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.uniform(0, 160, (64, 64, 3)), (0, 0), 1.0)
    with Session.create(tmp_path / "s", source={"kind": "images"}, width=64, height=64) as session:
        for index, gain in enumerate([1.0, 1.5, 1.0]):
            file = f"frames/{index:06d}.png"
            noisy = gain * picture + rng.normal(0, 1, picture.shape)
            write_png(session.path / file, np.clip(noisy, 0, 255).astype(np.uint8))
            session.append_frame(
                FrameRecord(index=index, file=file, width=64, height=64, flash=int(gain > 1))
            )
    assert rough_foreground(session, session.frames) == {}
