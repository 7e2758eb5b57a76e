"""A service without a network, for tests of the harness: top-down grasps on the highest thing it is shown.

Its second model, `heuristic`, finds none.

Speaks as much of the wire as the harness uses. Started like the service (`GRASP_PORT`), or with a port of 0, which it
then prints. `--die-after N` ends the process in the request after N answers, `--nothing` finds no grasps.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

MODEL = {"name": "tesnet", "version": "stub", "weights_sha256": "0" * 64}
REJECTED = dict.fromkeys(("support", "from_below", "approach", "target", "collision", "min_score", "duplicates"), 0)
TIMINGS = dict.fromkeys(("decode", "queue", "prepare", "candidates", "network", "rank", "total"), 1.0)


def top_down_grasp(points: np.ndarray, support_height: float) -> np.ndarray:
    """TCP pose (4, 4) over the highest point, closing across the shorter side of what is near it."""
    top = points[points[:, 2].argmax()]
    near = points[np.linalg.norm(points[:, :2] - top[:2], axis=1) < 0.03]
    middle = near.mean(axis=0)
    _, axes = np.linalg.eigh(np.cov((near[:, :2] - middle[:2]).T))
    y = np.array([*axes[:, 0], 0.0])
    z = np.array([0.0, 0.0, -1.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
    pose[:3, 3] = [*middle[:2], max(top[2] - 0.03, support_height + 0.014)]
    return pose


def grasp(pose: np.ndarray) -> dict[str, Any]:
    """A grasp as the wire has it."""
    quaternion = [0.0, 0.0, 0.0, 1.0]
    place = {"position": pose[:3, 3].tolist(), "quaternion_xyzw": quaternion}
    return {
        "score": 0.5,
        **place,
        "matrix": pose.tolist(),
        "hand_pose": place,
        "pregrasp": place,
        "width": 0.08,
        "approach_point": pose[:3, 3].tolist(),
        "contact_point": pose[:3, 3].tolist(),
    }


class Handler(BaseHTTPRequestHandler):
    """One connection."""

    protocol_version = "HTTP/1.1"
    options: argparse.Namespace
    answered = 0

    def do_GET(self) -> None:
        if self.path == "/model":
            network = {**MODEL, "card": {}, "configuration": {}}
            gripper = dict.fromkeys(
                ("max_width", "finger_depth", "finger_thickness", "finger_breadth", "hand_to_tcp"), 0.08
            )
            limits = dict.fromkeys(
                (
                    "max_points",
                    "max_body_bytes",
                    "max_grasps",
                    "max_approach_points",
                    "max_candidates",
                    "max_candidates_of_large_hands",
                    "queue_size",
                    "max_timeout_s",
                ),
                1000,
            )
            conventions = ["panda"]
            self._answer(
                {
                    "models": [network, {**network, "name": "heuristic"}],
                    "gripper": gripper,
                    "limits": limits,
                    "frame_conventions": conventions,
                    "content_types": ["application/octet-stream"],
                    "device": "cpu",
                }
            )
        else:
            self._answer({"status": "ready"})

    def do_POST(self) -> None:
        cls = type(self)
        if self.options.die_after is not None and cls.answered >= self.options.die_after:
            sys.stderr.write("the stub dies as it was told\n")
            sys.stderr.flush()
            os._exit(1)
        cls.answered += 1
        body = self.rfile.read(int(self.headers["Content-Length"]))
        points = np.frombuffer(body, dtype="<f4").reshape(-1, 3).astype(np.float64)
        options = {name: json.loads(values[0]) for name, values in parse_qs(urlsplit(self.path).query).items()}
        found = not self.options.nothing and options["model"] == "tesnet" and len(points) > 10
        grasps = [grasp(top_down_grasp(points, options["support_height"]))] if found else []
        counts = {
            "points": len(points),
            "prepared_points": len(points),
            "candidates": len(grasps),
            "collision_free": len(grasps),
            "returned": len(grasps),
            "rejected": REJECTED,
        }
        self._answer(
            {
                "grasps": grasps,
                "frame": "cloud",
                "model": {**MODEL, "name": options["model"]},
                "counts": counts,
                "reason": None if grasps else "no_candidates",
                "warnings": [],
                "timings_ms": TIMINGS,
                "request_id": self.headers.get("X-Request-ID", "none"),
            }
        )

    def _answer(self, document: dict[str, Any]) -> None:
        body = json.dumps(document).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Stay silent."""


def serve() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--die-after", type=int)
    parser.add_argument("--nothing", action="store_true")
    Handler.options = parser.parse_args()
    server = ThreadingHTTPServer(("127.0.0.1", int(os.environ.get("GRASP_PORT", "0"))), Handler)
    sys.stdout.write(f"http://127.0.0.1:{server.server_port}\n")
    sys.stdout.flush()
    server.serve_forever()


if __name__ == "__main__":
    serve()
