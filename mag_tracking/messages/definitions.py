"""Message definitions without comments, for recordings that are written without ROS.

The standard types are from ROS 2 Jazzy, the types of this package from `msg_defs/`. A test checks
that the definitions agree with these sources.
"""

DEFINITIONS: dict[str, str] = {
    'builtin_interfaces/msg/Duration': (
        'int32 sec\nuint32 nanosec\n'),
    'builtin_interfaces/msg/Time': (
        'int32 sec\nuint32 nanosec\n'),
    'std_msgs/msg/ColorRGBA': (
        'float32 r\nfloat32 g\nfloat32 b\nfloat32 a\n'),
    'std_msgs/msg/Header': (
        'builtin_interfaces/Time stamp\nstring frame_id\n'),
    'geometry_msgs/msg/Point': (
        'float64 x\nfloat64 y\nfloat64 z\n'),
    'geometry_msgs/msg/Pose': (
        'geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation\n'),
    'geometry_msgs/msg/PoseStamped': (
        'std_msgs/Header header\ngeometry_msgs/Pose pose\n'),
    'geometry_msgs/msg/PoseWithCovariance': (
        'geometry_msgs/Pose pose\nfloat64[36] covariance\n'),
    'geometry_msgs/msg/PoseWithCovarianceStamped': (
        'std_msgs/Header header\ngeometry_msgs/PoseWithCovariance pose\n'),
    'geometry_msgs/msg/Quaternion': (
        'float64 x 0\nfloat64 y 0\nfloat64 z 0\nfloat64 w 1\n'),
    'geometry_msgs/msg/Transform': (
        'geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation\n'),
    'geometry_msgs/msg/TransformStamped': (
        'std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform\n'),
    'geometry_msgs/msg/Twist': (
        'geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular\n'),
    'geometry_msgs/msg/TwistWithCovariance': (
        'geometry_msgs/Twist twist\nfloat64[36] covariance\n'),
    'geometry_msgs/msg/Vector3': (
        'float64 x\nfloat64 y\nfloat64 z\n'),
    'sensor_msgs/msg/CompressedImage': (
        'std_msgs/Header header\nstring format\nuint8[] data\n'),
    'sensor_msgs/msg/MagneticField': (
        'std_msgs/Header header\ngeometry_msgs/Vector3 magnetic_field\n'
        'float64[9] magnetic_field_covariance\n'),
    'nav_msgs/msg/Odometry': (
        'std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/PoseWithCovariance pose\n'
        'geometry_msgs/TwistWithCovariance twist\n'),
    'nav_msgs/msg/Path': (
        'std_msgs/Header header\ngeometry_msgs/PoseStamped[] poses\n'),
    'tf2_msgs/msg/TFMessage': (
        'geometry_msgs/TransformStamped[] transforms\n'),
    'visualization_msgs/msg/Marker': (
        'int32 ARROW=0\nint32 CUBE=1\nint32 SPHERE=2\nint32 CYLINDER=3\nint32 LINE_STRIP=4\n'
        'int32 LINE_LIST=5\nint32 CUBE_LIST=6\nint32 SPHERE_LIST=7\nint32 POINTS=8\n'
        'int32 TEXT_VIEW_FACING=9\nint32 MESH_RESOURCE=10\nint32 TRIANGLE_LIST=11\n'
        'int32 ARROW_STRIP=12\nint32 ADD=0\nint32 MODIFY=0\nint32 DELETE=2\nint32 DELETEALL=3\n'
        'std_msgs/Header header\nstring ns\nint32 id\nint32 type\nint32 action\n'
        'geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\nstd_msgs/ColorRGBA color\n'
        'builtin_interfaces/Duration lifetime\nbool frame_locked\ngeometry_msgs/Point[] points\n'
        'std_msgs/ColorRGBA[] colors\nstring texture_resource\n'
        'sensor_msgs/CompressedImage texture\nvisualization_msgs/UVCoordinate[] uv_coordinates\n'
        'string text\nstring mesh_resource\nvisualization_msgs/MeshFile mesh_file\n'
        'bool mesh_use_embedded_materials\n'),
    'visualization_msgs/msg/MarkerArray': (
        'visualization_msgs/Marker[] markers\n'),
    'visualization_msgs/msg/MeshFile': (
        'string filename\nuint8[] data\n'),
    'visualization_msgs/msg/UVCoordinate': (
        'float32 u\nfloat32 v\n'),
    'mag_tracking_msgs/msg/Disturbance': (
        'std_msgs/Header header\nuint32 id\nbool ended\nbuiltin_interfaces/Time begin\n'
        'float64 largest\nstring[] sensors\nfloat64 uniform\nuint32 track_id\n'),
    'mag_tracking_msgs/msg/FieldReadings': (
        'std_msgs/Header header\nstring[] sensors\nuint16[] sensor\nint64[] stamp\n'
        'float64[] field\nfloat64[] covariance\n'),
    'mag_tracking_msgs/msg/Hypothesis': (
        'string arrival\nstring kind\nfloat64 weight\ngeometry_msgs/Point position\n'
        'geometry_msgs/Vector3 velocity\nfloat64[36] covariance\ngeometry_msgs/Vector3 moment\n'),
    'mag_tracking_msgs/msg/SmoothedTrack': (
        'std_msgs/Header header\nuint32 track_id\nstring kind\nfloat64 length\n'
        'float64 length_std\nbool ambiguous\nbool[] pose_ambiguous\n'
        'geometry_msgs/PoseWithCovarianceStamped[] poses\ngeometry_msgs/Vector3[] velocities\n'),
    'mag_tracking_msgs/msg/Track': (
        'uint8 ACTIVE=0\nuint8 ENDED=1\nstd_msgs/Header header\nuint32 id\nuint8 status\n'
        'geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/Vector3 velocity\n'
        'float64[36] covariance\ngeometry_msgs/Vector3 moment\nfloat64[9] moment_covariance\n'
        'float64 existence\nfloat64 weight\nfloat64 normalised_innovation\n'
        'float64[] innovation_by_sensor\nuint32 degrees_of_freedom\nstring arrival\nstring kind\n'
        'float64 kind_weight\nfloat64 length\nfloat64 length_std\nbool ambiguous\n'
        'bool[6] unobservable\nfloat64[] predicted_field\nfloat64[] mounting\n'
        'float64[] mounting_covariance\nstring[] doubts\n'
        'mag_tracking_msgs/Hypothesis[] arrivals\n'),
    'mag_tracking_msgs/msg/TrackArray': (
        'std_msgs/Header header\nmag_tracking_msgs/Track[] tracks\n'),
}
"""Definition of each message type, as {type: definition}."""
