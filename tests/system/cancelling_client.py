"""Asks for a registration of the latest scan and cancels it at once; prints the error code of the answer."""

from __future__ import annotations

import rclpy
from mdf_interfaces.action import RegisterScan
from rclpy.action import ActionClient

PATIENCE_SECONDS = 10.0

rclpy.init()
node = rclpy.create_node("cancelling_client")
client = ActionClient(node, RegisterScan, "register_scan")
if client.wait_for_server(PATIENCE_SECONDS):
    asked = client.send_goal_async(RegisterScan.Goal(use_latest=True))
    rclpy.spin_until_future_complete(node, asked, timeout_sec=PATIENCE_SECONDS)
    if (goal := asked.result()) is not None:
        answered = goal.get_result_async()
        goal.cancel_goal_async()
        rclpy.spin_until_future_complete(node, answered, timeout_sec=PATIENCE_SECONDS)
        if (answer := answered.result()) is not None:
            print(answer.result.error_code)
