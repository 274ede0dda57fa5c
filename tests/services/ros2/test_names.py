"""Keys, tokens, quality of service, gids and attachments: vectors written by hand from the design text of rmw_zenoh."""

import pytest
import xxhash
import zenoh.ext

from penumbra.services.ros2 import names
from penumbra.services.ros2.names import Profile

HASH = "RIHS01_26432f9803e43727d3c8f668d1fdb3c630f548af631e2f4e31382371bfea3b6e"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
NODE = names.Node(domain=0, zid="aac3178e146ba6f1fc6e6a4085e77f21", namespace="/", name="listener")


def test_the_key_of_a_topic_has_its_domain_name_type_and_hash():
    key = "0/penumbra/forearm/pose/geometry_msgs::msg::dds_::PoseWithCovarianceStamped_/" + HASH
    assert names.topic_key(0, "/penumbra/forearm/pose", POSE, HASH) == key
    assert names.topic_key(7, "/tf/", "tf2_msgs/msg/TFMessage", "RIHS01_e3") == "7/tf/tf2_msgs::msg::dds_::TFMessage_/RIHS01_e3"


def test_a_node_s_token_has_a_percent_sign_for_every_slash():
    assert names.node_token(NODE) == "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%/listener"
    node = names.Node(domain=2, zid="aac3178e146ba6f1fc6e6a4085e77f21", namespace="/penumbra", name="ros2")
    assert names.node_token(node) == "@ros2_lv/2/aac3178e146ba6f1fc6e6a4085e77f21/0/0/NN/%/%penumbra/ros2"


def test_an_endpoint_s_token_ends_with_topic_type_hash_and_quality_of_service():
    # the example of the design text, a subscription of /chatter, with the identity of its session
    chatter = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
    expected = (
        "@ros2_lv/0/aac3178e146ba6f1fc6e6a4085e77f21/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/"
        f"{chatter}/::,10:,:,:,,"
    )
    assert names.endpoint_token(NODE, 10, "MS", "/chatter", "std_msgs/msg/String", chatter, Profile(10)) == expected
    assert zenoh.KeyExpr(expected), "Zenoh takes it as a key"


@pytest.mark.parametrize(
    ("profile", "text"),
    [
        (Profile(10), "::,10:,:,:,,"),
        (Profile(42), "::,:,:,:,,"),  # the depth of the default profile
        (Profile(1, is_latched=True), ":1:,1:,:,:,,"),
        (Profile(5, is_reliable=False), "2::,5:,:,:,,"),
    ],
)
def test_what_a_profile_shares_with_the_default_one_is_empty_in_a_token(profile, text):
    assert str(profile) == text


def test_a_gid_is_the_hash_of_the_token_low_half_first():
    token = names.node_token(NODE)
    digest = xxhash.xxh3_128_digest(token.encode())  # big-endian: the high half first
    assert names.gid(token) == digest[8:][::-1] + digest[:8][::-1]


def test_an_attachment_is_what_zenoh_s_own_serialisation_makes_of_number_time_and_gid():
    gid = bytes(range(16))
    found = names.attachment(1, 1_700_000_000_123_456_789, gid)
    assert len(found) == 33
    assert found[:8] == b"\x01" + bytes(7) and found[16] == 16 and found[17:] == gid
    parts = (zenoh.ext.Int64(1), zenoh.ext.Int64(1_700_000_000_123_456_789), gid)
    assert found == b"".join(zenoh.ext.z_serialize(part).to_bytes() for part in parts)


@pytest.mark.parametrize("text", ["joint_states", "/", "//a", "/a/", "/1a", "/a b", "/a-b", "/ä", ""])
def test_a_name_that_ros_does_not_take_is_refused(text):
    with pytest.raises(ValueError, match="expected a name of ROS such as /joint_states"):
        names.topic(text)


def test_names_of_the_cell_become_names_of_ros():
    assert names.within("/penumbra", "forearm/pose") == "/penumbra/forearm/pose"
    assert names.within("/", "forearm/pose") == "/forearm/pose"
    assert [names.safe(text) for text in ("left-arm", "2nd", "p0")] == ["left_arm", "_2nd", "p0"]
    assert names.namespace("/") == "/" and names.namespace("/cell/one") == "/cell/one"
