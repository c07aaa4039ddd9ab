"""The rollout of a thermal network and its exact sensitivities."""
