"""Topics that are recorded of the network file, for the tests."""

FIELDS = ('/mag_1/imu/mag', '/mag_2/imu/mag')
IMUS = ('/mag_1/imu/data_raw', '/mag_2/imu/data_raw')
