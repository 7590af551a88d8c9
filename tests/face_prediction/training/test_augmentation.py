"""Mirrored, moved and relit sequences: all frames alike, landmarks with their images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from face_prediction.models.interface import Future, History
from face_prediction.tracking.geometry import read_canonical_face, rigid_face
from face_prediction.training import windows as augmentation
from face_prediction.training.windows import (
    MIDLINE,
    WindowBatch,
    augment,
    mirror_indices,
    mirrored_images,
    mirrored_landmarks,
    moved_images,
    relit,
)


class TestMirror:
    def test_it_is_its_own_inverse_and_leaves_the_midline(self) -> None:
        mirror = mirror_indices()
        np.testing.assert_array_equal(mirror[mirror], np.arange(468))
        assert set(np.flatnonzero(mirror == np.arange(468))) == set(MIDLINE)

    def test_it_is_that_of_the_landmarks_the_head_pose_is_fitted_to(self) -> None:
        face = rigid_face()
        known = np.flatnonzero(face.weights > 0)
        np.testing.assert_array_equal(
            face.vertices[mirror_indices()[known]], face.vertices[known] * (-1, 1, 1)
        )

    def test_eyes_and_mouth(self) -> None:
        mirror = mirror_indices()
        for right, left in ((33, 263), (133, 362), (61, 291), (159, 386), (145, 374), (127, 356)):
            assert mirror[right] == left

    @pytest.mark.shared
    def test_it_is_that_of_the_canonical_face(self, shared_dir: Path) -> None:
        vertices = read_canonical_face(shared_dir / "faces" / "face_landmarker.task").vertices
        apart = np.linalg.norm(vertices[:, None] - vertices * (-1, 1, 1), axis=-1)
        np.testing.assert_array_equal(apart.argmin(axis=1), mirror_indices())


class TestAugmentation:
    def batch(self, rows: int = 64) -> WindowBatch:
        """Faces whose nose tip (landmark 1) and a red pixel are at the same place."""
        rng = np.random.default_rng(0)
        landmarks = torch.from_numpy(rng.uniform(0, 1, (rows, 5, 468, 2)).astype(np.float32))
        images = torch.full((rows, 5, 16, 16, 3), 100, dtype=torch.uint8)
        for row in range(rows):
            for frame in range(5):
                x, y = rng.integers(2, 14, size=2)  # so that it is never moved out
                images[row, frame, y, x, 0] = 255
                landmarks[row, frame, 1] = torch.tensor([(x + 0.5) / 16, (y + 0.5) / 16])
        return WindowBatch(
            History(landmarks[:, :3], images[:, :3]), Future(landmarks[:, 3:], images[:, 3:])
        )

    def test_landmarks_and_pictures_are_turned_together(self) -> None:
        for part in augment(self.batch(), np.random.default_rng(0)):
            red = part.images[..., 0].float() - part.images[..., 1].float()
            place = red.flatten(2).argmax(dim=2)
            seen = torch.stack([place % 16 + 0.5, place // 16 + 0.5], dim=-1) / 16
            torch.testing.assert_close(part.landmarks[:, :, 1], seen)

    def test_history_and_future_are_turned_together_and_about_half_of_them(
        self, monkeypatch
    ) -> None:
        monkeypatch.setattr(augmentation, "MOVE", 0.0)
        before = self.batch()
        after = augment(before, np.random.default_rng(1))
        is_turned = [
            torch.isclose(1 - old.landmarks[:, 0, 1, 0], new.landmarks[:, 0, 1, 0])
            & ~torch.isclose(old.landmarks[:, 0, 1, 0], new.landmarks[:, 0, 1, 0])
            for old, new in zip(before, after, strict=True)
        ]
        assert torch.equal(*is_turned)
        assert 20 < int(is_turned[0].sum()) < 44  # 3 standard deviations about 32

    def test_a_sequence_is_moved_as_a_whole_by_up_to_two_pixels_here(self) -> None:
        """0.16 of 16 pixels; on landmark 10, which is its own mirror image."""
        before = self.batch()
        moved = []
        for old, new in zip(before, augment(before, np.random.default_rng(3)), strict=True):
            u, v = (torch.stack([x.landmarks[:, :, 10, k] for x in (old, new)]) for k in (0, 1))
            moved.append(16 * (v[1] - v[0]))
            plain, turned = 16 * (u[1] - u[0]), 16 * (u[1] - (1 - u[0]))
            assert bool(
                ((plain - plain.round()).abs() < 1e-4)[:, 0]
                .logical_or(((turned - turned.round()).abs() < 1e-4)[:, 0])
                .all()
            )
        steps = torch.cat(moved, dim=1)
        torch.testing.assert_close(steps, steps[:, :1].round().expand_as(steps), atol=1e-4, rtol=0)
        assert set(steps[:, 0].round().int().tolist()) == {-1, 0, 1}

    def test_what_moves_in_is_black(self) -> None:
        images = torch.arange(1, 17, dtype=torch.uint8).reshape(1, 1, 4, 4, 1).expand(3, 1, 4, 4, 3)
        moves = torch.tensor([[1, 0], [0, -2], [-1, 1]])
        right, up, both = moved_images(images, moves)[:, 0, :, :, 0].tolist()
        assert right == [[0, 1, 2, 3], [0, 5, 6, 7], [0, 9, 10, 11], [0, 13, 14, 15]]
        assert up == [[9, 10, 11, 12], [13, 14, 15, 16], [0] * 4, [0] * 4]
        assert both == [[0] * 4, [2, 3, 4, 0], [6, 7, 8, 0], [10, 11, 12, 0]]

    def test_left_and_right_landmarks_change_places(self) -> None:
        landmarks = torch.rand(2, 1, 468, 2)
        turned = mirrored_landmarks(landmarks, torch.tensor([True, False]))
        torch.testing.assert_close(turned[0, 0, 33, 0], 1 - landmarks[0, 0, 263, 0])
        torch.testing.assert_close(turned[0, 0, 33, 1], landmarks[0, 0, 263, 1])
        assert torch.equal(turned[1], landmarks[1])

    def test_twice_in_the_mirror_is_as_before(self) -> None:
        part = self.batch(4).history
        both = torch.ones(4, dtype=torch.bool)
        twice = mirrored_landmarks(mirrored_landmarks(part.landmarks, both), both)
        torch.testing.assert_close(twice, part.landmarks)
        assert torch.equal(mirrored_images(mirrored_images(part.images, both), both), part.images)

    def test_light_is_multiplied_shifted_and_clipped(self) -> None:
        images = torch.tensor([0, 100, 250], dtype=torch.uint8).expand(2, 1, 1, 1, 3)
        lit = relit(images, torch.tensor([1.2, 1.0]), torch.tensor([0.1, -0.02]))
        assert lit[0].flatten().tolist() == [26, 146, 255]  # 25.5, 145.5, 325.5
        assert lit[1].flatten().tolist() == [0, 95, 245]  # -5.1, 94.9, 244.9

    def test_all_frames_of_a_sequence_get_the_same_light(self) -> None:
        after = augment(self.batch(), np.random.default_rng(2))
        green = torch.cat([part.images[..., 1] for part in after], dim=1)
        frames = green[:, :, 2:14, 2:14]  # all alike, but for what came in at the edges
        assert torch.equal(frames.amax(dim=(1, 2, 3)), frames.amin(dim=(1, 2, 3)))
        assert len(frames.amax(dim=(1, 2, 3)).unique()) > 20
