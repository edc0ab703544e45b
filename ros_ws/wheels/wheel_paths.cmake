# Makes the ROS 2 wheels usable from a stock CMakeLists.txt; passed as CMAKE_PROJECT_INCLUDE.
#
# The CMake targets exported by the wheels carry the Python and NumPy include folders of the machine that built the
# wheels (/opt/python/cpXY...). CMake refuses targets whose include folders do not exist, so at the end of the package's
# configure step those folders are replaced by the ones of the Python in use. Needs CMake 3.21 (IMPORTED_TARGETS).
function(_wheel_paths_mend)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT folders)
      continue()
    endif()
    set(mended)
    foreach(folder IN LISTS folders)
      if(NOT folder MATCHES "^/opt/(_internal|python)/")
        list(APPEND mended "${folder}")
      elseif(folder MATCHES "numpy")
        list(APPEND mended ${Python3_NumPy_INCLUDE_DIRS})
      else()
        list(APPEND mended ${Python3_INCLUDE_DIRS})
      endif()
    endforeach()
    set_target_properties(${target} PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "${mended}")
  endforeach()
endfunction()

cmake_language(DEFER CALL _wheel_paths_mend)
