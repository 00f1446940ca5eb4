"""Registration of the environments for `gymnasium.make`."""

from sim.runtime.optional_packages import require_extra

NAMESPACE = "sulcus"  # Prefix of the environments' names.
NAMES = ("Palpate", "Retract", "Debulk")  # Names of the environments.
MAX_STEPS = 200
"""Number of steps after which an episode is truncated."""


def register_environments() -> None:
    """Register the environments once; the import of `scenes.gym` calls this function.

    Raises
    ------
    InputError
        Gymnasium is not installed.
    """
    with require_extra("gym", "these environments need"):
        from gymnasium.envs.registration import register, registry
    for name in NAMES:
        known = f"{NAMESPACE}/{name}-v0"
        if known not in registry:
            register(
                known,
                "scenes.gym.environment:SurgeryEnv",
                max_episode_steps=MAX_STEPS,
                kwargs={"task": name.lower()},
                vector_entry_point="scenes.gym.environment:SurgeryVectorEnv",
            )
