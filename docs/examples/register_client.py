"""Sends a scan file (mm) to the service `register` and tells how the part is distorted."""

import sys

import rclpy
from mdf_interfaces.srv import Register
from std_msgs.msg import Header

import mdf_core as mdf
from mdf_nodes.conversions import displacement_from_message, scan_message

rclpy.init()
node = rclpy.create_node("register_client")
register = node.create_client(Register, "register")
header = Header(stamp=node.get_clock().now().to_msg(), frame_id="scanner")
request = Register.Request(scan=scan_message(mdf.load_scan(sys.argv[1], unit="mm"), header), part_id="part 17")
answer = None
while answer is None:  # a node that has just started may miss a request: ask again
    if register.wait_for_service(timeout_sec=1.0):
        future = register.call_async(request)
        rclpy.spin_until_future_complete(node, future, timeout_sec=60.0)
        answer = future.result()
if answer.error_code:
    sys.exit(f"error {answer.error_code}: {answer.error_msg}")
field = displacement_from_message(answer.displacement)  # mm, one row per vertex of the design
print(f"largest displacement {answer.inspection.max_displacement * 1000:.3f} mm")
print(f"{field.supported.mean():.0%} of {len(field)} vertices measured")
