"""Robots that run a policy by themselves, each in its own process; nothing here imports torch."""

from gnn_policy.robot.message import Message
from gnn_policy.robot.robot import Robot

__all__ = ["Message", "Robot"]
