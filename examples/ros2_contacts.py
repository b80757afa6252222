"""ROS 2 node that publishes each contact with a position as geographic_msgs/GeoPointStamped."""

import json

import rclpy
from geographic_msgs.msg import GeoPointStamped
from rclpy.node import Node
from std_msgs.msg import String


class Contacts(Node):
    """Subscribes to the JSON of ros2_mirror.py, and publishes positions on /sonarpost/positions."""

    def __init__(self) -> None:
        super().__init__("sonarpost_contacts")
        self._positions = self.create_publisher(GeoPointStamped, "/sonarpost/positions", 10)
        self.create_subscription(String, "/sonarpost/contacts", self._receive, 10)

    def _receive(self, message: String) -> None:
        record = json.loads(message.data)
        contact = record.get("contact")
        if record["type"] != "reconstructed_image" or not contact or contact.get("lat_deg") is None:
            return
        position = GeoPointStamped()
        position.header.stamp = self.get_clock().now().to_msg()
        position.header.frame_id = f"{record['vehicle_id']}/{record['image_id']}"
        position.position.latitude = contact["lat_deg"]
        position.position.longitude = contact["lon_deg"]
        self._positions.publish(position)
        self.get_logger().info(f"{position.header.frame_id} p_mine_like={contact.get('p_mine_like')}")


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    rclpy.spin(Contacts())


if __name__ == "__main__":
    main()
