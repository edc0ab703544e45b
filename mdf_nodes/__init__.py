"""The nodes of the print cell: thin shells of rclpy around :mod:`mdf_core`."""
