"""Topics of the bundled network file that the recorder records."""

FIELDS = ('/mag_1/imu/mag', '/mag_2/imu/mag')
IMUS = ('/mag_1/imu/data_raw', '/mag_2/imu/data_raw')
