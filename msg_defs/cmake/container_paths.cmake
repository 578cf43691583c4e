# Workaround: the ros-jazzy-* wheels of PyPI were built in a container, and their imported targets
# still name the Python headers of that container (/opt/python/...). CMake refuses folders that do
# not exist. The real headers come from FindPython3, so the entries can be dropped; with a ROS from
# apt there are none. It can go when the wheels' exported targets no longer name /opt/python.
get_property(imported DIRECTORY PROPERTY IMPORTED_TARGETS)
foreach(target IN LISTS imported)
  get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
  if(folders)
    list(FILTER folders EXCLUDE REGEX "^/opt/python/")
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${folders}")
  endif()
endforeach()
