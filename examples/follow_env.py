"""A Gymnasium environment: follow a leader by the images of the follower's camera.

Needs ``pip install gymnasium`` beside dmrl. It works with any training code for Gymnasium.
"""

from typing import Any

import gymnasium
import numpy as np

from dmrl.simulation import Simulation

DISTANCE_M = 0.7
LIMITS = np.array([1.0, 1.0, 0.4, 1.5], np.float32)  # m/s, m/s, m/s, rad/s
FAR_M, NEAR_M = 3.0, 0.2


class FollowEnv(gymnasium.Env[dict[str, Any], np.ndarray]):
    """An environment in which actions fly cf1 while cf2 flies a figure of eight in front of it.

    An action is four fractions, -1 to 1, of LIMITS: forward, left, up and yaw rate.
    """

    def __init__(self, duration_s: float = 30.0) -> None:
        self.simulation = Simulation(robots=2, flown=1, duration_s=duration_s)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = gymnasium.spaces.Dict(
            {
                "image": gymnasium.spaces.Box(0, 255, (224, 320, 3), np.uint8),
                "motion": gymnasium.spaces.Box(-10.0, 10.0, (4,), np.float32),
            }
        )

    def _observe(self, seen: Any) -> dict[str, Any]:
        own = [*seen.velocity_mps, seen.height_m, seen.yaw_rate_radps]
        return {
            "image": self.simulation.render("cf1").rgb,
            "motion": np.clip(own, -10, 10).astype(np.float32),
        }

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Start a flight; the seed chooses the path of cf2 and the noise."""
        super().reset(seed=seed)
        flight = int(self.np_random.integers(2**31)) if seed is None else seed
        return self._observe(self.simulation.reset(flight)["cf1"]), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Fly an action for 0.05 s. The reward is 1 with cf2 straight ahead at DISTANCE_M."""
        seen = self.simulation.step({"cf1": (np.clip(action, -1, 1) * LIMITS).tolist()})["cf1"]
        x, y, z = self.simulation.peer_position("cf1", "cf2")
        distance = float(np.linalg.norm((x, y, z)))
        bearing = float(np.arctan2(y, x))
        reward = float(np.exp(-abs(distance - DISTANCE_M)) * np.cos(bearing))
        over = not NEAR_M < distance < FAR_M
        info = {"distance_m": distance, "bearing_rad": bearing}
        return self._observe(seen), reward, over, self.simulation.is_over, info

    def close(self) -> None:
        """End the simulation."""
        self.simulation.close()


if __name__ == "__main__":
    env = FollowEnv(duration_s=5.0)
    env.reset(seed=1)
    total, over = 0.0, False
    info = {"distance_m": DISTANCE_M, "bearing_rad": 0.0}
    # The true position steers here; a policy would steer by the image.
    while not over:
        ahead = 1.2 * (info["distance_m"] - DISTANCE_M) + 0.3
        _, reward, crashed, ended, info = env.step(
            np.array([ahead, 0.0, 0.0, 2.0 * info["bearing_rad"] / LIMITS[3]])
        )
        total, over = total + reward, crashed or ended
    print(f"reward {total:.1f} over {env.simulation.time_s:.0f} s, {info['distance_m']:.2f} m away")
    env.close()
