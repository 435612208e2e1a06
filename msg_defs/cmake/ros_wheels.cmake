# Makes this package build over ROS 2 as PyPI wheels. On a ROS installation this file does nothing.
#
# The wheels differ from an installation in three ways:
#  - their prefix is a Python environment that no setup.bash has put on the CMake and ament paths;
#  - their exported targets name include directories of the machine that built them;
#  - pip installs this project as one wheel, so the Python package's share/ is installed from here.

find_package(Python3 REQUIRED COMPONENTS Interpreter)
# pip builds in an environment of its own beside the one that it installs into, which may hold wheels without generators.
execute_process(
  COMMAND ${Python3_EXECUTABLE} -c
    "import pathlib, sys; sites = [p for p in map(pathlib.Path, sys.path) if (p / 'ros_wheels_bootstrapper').is_dir()]; \
prefixes = [p.resolve().parents[2] for p in sites]; \
print(next((p for p in prefixes if (p / 'share/rosidl_default_generators').is_dir()), ''), end='')"
  OUTPUT_VARIABLE ros_wheels_prefix
  ERROR_QUIET
)
if(NOT ros_wheels_prefix)
  return()
endif()

message(STATUS "Building over the ROS 2 wheels in ${ros_wheels_prefix}")
list(PREPEND CMAKE_PREFIX_PATH "${ros_wheels_prefix}")
set(ENV{AMENT_PREFIX_PATH} "${ros_wheels_prefix}:$ENV{AMENT_PREFIX_PATH}")

function(drop_missing_include_directories)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(directories ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT directories)
      continue()
    endif()
    set(present)
    foreach(directory IN LISTS directories)
      if(NOT directory MATCHES "^/opt/python/" OR EXISTS "${directory}")
        list(APPEND present "${directory}")
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${present}")
  endforeach()
endfunction()
cmake_language(DEFER CALL drop_missing_include_directories)

if(SKBUILD)
  set(project_root "${CMAKE_CURRENT_SOURCE_DIR}/..")
  install(FILES "${project_root}/resource/magnetosuture_thread"
    DESTINATION share/ament_index/resource_index/packages)
  install(FILES "${project_root}/package.xml" DESTINATION share/magnetosuture_thread)
  foreach(folder config launch)
    install(DIRECTORY "${project_root}/${folder}" DESTINATION share/magnetosuture_thread)
  endforeach()
endif()
