"""
Interface packages that the wheels of ROS lack, generated and compiled from their definitions.

The generators of rosidl are among the wheels; what calls them here is CMake in a ROS workspace. The
definitions are the published ones, reduced to their fields.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

PREFIX = Path(sys.prefix)
INCLUDE, LIBRARIES, SHARE = PREFIX / "include", PREFIX / "lib", PREFIX / "share"
KNOWN = ("builtin_interfaces", "geometry_msgs", "service_msgs", "std_msgs")

FIX_NUMBERS = (
    *("latitude", "longitude", "altitude", "track", "speed", "climb", "pitch", "roll", "dip"),
    *("time", "gdop", "pdop", "hdop", "vdop", "tdop", "err", "err_horz", "err_vert"),
    *("err_track", "err_speed", "err_climb", "err_time", "err_pitch", "err_roll", "err_dip"),
)
DEFINITIONS = {
    "geographic_msgs": {
        "msg/GeoPoint.msg": "float64 latitude\nfloat64 longitude\nfloat64 altitude\n",
        "msg/GeoPose.msg": "GeoPoint position\ngeometry_msgs/Quaternion orientation\n",
    },
    "robot_localization": {
        "srv/FromLL.srv": "geographic_msgs/GeoPoint ll_point\n---\ngeometry_msgs/Point map_point\n",
        "srv/ToLL.srv": "geometry_msgs/Point map_point\n---\ngeographic_msgs/GeoPoint ll_point\n",
        "srv/FromLLArray.srv": (
            "geographic_msgs/GeoPoint[] ll_points\n---\ngeometry_msgs/Point[] map_points\n"
        ),
        "srv/SetDatum.srv": "geographic_msgs/GeoPose geo_pose\n---\n",
    },
    "tf2_msgs": {
        "msg/TFMessage.msg": "geometry_msgs/TransformStamped[] transforms\n",
    },
    "gps_msgs": {
        "msg/GPSStatus.msg": (
            "std_msgs/Header header\n"
            "uint16 satellites_used\nint32[] satellite_used_prn\nuint16 satellites_visible\n"
            "int32[] satellite_visible_prn\nint32[] satellite_visible_z\n"
            "int32[] satellite_visible_azimuth\nint32[] satellite_visible_snr\n"
            "int16 STATUS_NO_FIX=-1\nint16 STATUS_FIX=0\nint16 STATUS_RTK_FIX=19\n"
            "int16 STATUS_RTK_FLOAT=20\nint16 status\n"
            "uint16 motion_source\nuint16 orientation_source\nuint16 position_source\n"
        ),
        "msg/GPSFix.msg": "std_msgs/Header header\nGPSStatus status\n"
        + "".join(f"float64 {name}\n" for name in FIX_NUMBERS)
        + "float64[9] position_covariance\nuint8 COVARIANCE_TYPE_UNKNOWN=0\n"
        "uint8 COVARIANCE_TYPE_APPROXIMATED=1\nuint8 COVARIANCE_TYPE_DIAGONAL_KNOWN=2\n"
        "uint8 COVARIANCE_TYPE_KNOWN=3\nuint8 position_covariance_type\n",
    },
}
SUPPORTS = ("rosidl_typesupport_fastrtps_c", "rosidl_typesupport_introspection_c")
NEEDS = {"robot_localization": ("geographic_msgs",)}


def why_not() -> str:
    """Return what is missing for `build`; empty where nothing is."""
    if shutil.which("gcc") is None or shutil.which("g++") is None:
        return "no C and C++ compilers"
    if not (Path(sysconfig.get_path("include")) / "Python.h").is_file():
        return "no headers of Python"
    if not (INCLUDE / "rosidl_typesupport_fastrtps_c").is_dir():
        return "no headers of ROS beside its Python packages"
    return ""


def build(cache: pytest.Cache) -> Path:
    """
    Return a folder for ``PYTHONPATH`` with all packages; skip the test where that cannot be.

    It takes half a minute of a processor, once: pytest's cache keeps the result.
    """
    reason = why_not()
    if reason:
        pytest.skip(f"interfaces cannot be compiled: {reason}")
    key = hashlib.sha256(Path(__file__).read_bytes() + sys.version.encode()).hexdigest()[:12]
    folder = cache.mkdir(f"interfaces-{key}")
    complete = folder / "complete"
    if not complete.is_file():
        for package in DEFINITIONS:
            _Package(folder, package).build()
        complete.touch()
    return folder


class _Package:
    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self.name = folder, name
        self.source = folder / "source" / name
        self.needs = NEEDS.get(name, ())
        self.generated = folder / "generated" / name
        self.described = folder / "introspection" / name  # files with the same names as others

    def build(self) -> None:
        from rosidl_adapter.msg import convert_msg_to_idl
        from rosidl_adapter.srv import convert_srv_to_idl
        from rosidl_generator_c import generate_c
        from rosidl_generator_py import generate_py
        from rosidl_generator_type_description import generate_type_hash
        from rosidl_typesupport_c import generate_c as generate_typesupport_c
        from rosidl_typesupport_fastrtps_c import generate_typesupport_fastrtps_c
        from rosidl_typesupport_introspection_c import generate_c as generate_introspection_c

        for path, text in DEFINITIONS[self.name].items():
            file = self.source / path
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text)
            convert = convert_msg_to_idl if file.suffix == ".msg" else convert_srv_to_idl
            convert(self.source, self.name, Path(path), file.parent)
        generate_type_hash(self.arguments("type_description", self.source))
        generate_c(self.arguments("generator_c"))
        generate_typesupport_fastrtps_c(self.arguments("typesupport_fastrtps_c"))
        generate_introspection_c(self.arguments("typesupport_introspection_c", self.described))
        generate_typesupport_c(self.arguments("typesupport_c"), list(SUPPORTS))
        generate_py(
            self.arguments("generator_py", self.folder / self.name), ["rosidl_typesupport_c"]
        )
        (self.folder / self.name / "__init__.py").touch()
        self.compile()

    def arguments(self, generator: str, output: Path | None = None) -> str:
        """Write what a generator is given, as rosidl_cmake does; return the file's path."""
        stems = [str(Path(path).with_suffix("")) for path in DEFINITIONS[self.name]]
        given = {
            "package_name": self.name,
            "idl_tuples": [f"{self.source}:{stem}.idl" for stem in stems],
            "output_dir": str(output or self.generated),
            "template_dir": str(SHARE / f"rosidl_{generator}" / "resource"),
            "target_dependencies": [],
            "ros_interface_dependencies": [],
            "ros_interface_files": [str(self.source / path) for path in DEFINITIONS[self.name]],
        }
        if generator == "type_description":
            given["include_paths"] = [
                *(f"{package}:{SHARE / package}" for package in KNOWN),
                *(f"{package}:{self.folder / 'source' / package}" for package in self.needs),
            ]
        if generator == "generator_c":
            given["type_description_tuples"] = [
                f"{stem}.idl:{self.source}/{stem}.json" for stem in stems
            ]
        file = self.source / f"{generator}.json"
        file.write_text(json.dumps(given))
        return str(file)

    def compile(self) -> None:
        import numpy as np

        python = self.folder / self.name
        # Templates of CMake: what a compiler is told of the visibility of symbols.
        for part, folder in (
            ("generator_c", self.generated),
            ("typesupport_fastrtps_c", self.generated),
            ("typesupport_introspection_c", self.described),
            ("typesupport_c", self.generated),
        ):
            header = folder / f"msg/rosidl_{part}__visibility_control.h"
            header.parent.mkdir(parents=True, exist_ok=True)
            words = (f"ROSIDL_{part.upper()}_{word}" for word in ("PUBLIC", "IMPORT", "EXPORT"))
            header.write_text(
                "#pragma once\n" + "".join(f"#define {word}_{self.name}\n" for word in words)
            )
        include = [
            self.generated.parent,
            self.described.parent,
            Path(sysconfig.get_path("include")),
            Path(np.get_include()),
            *INCLUDE.iterdir(),
            INCLUDE,
        ]
        own = [*sorted(self.generated.rglob("*.c")), *sorted(python.rglob("*_s.c"))]
        described = [source for source in own if source.stem.endswith("__description")]
        own = [source for source in own if source not in described]
        supports = {
            "rosidl_typesupport_fastrtps_c": sorted(self.generated.rglob("*.cpp")),
            "rosidl_typesupport_introspection_c": sorted(self.described.rglob("*.c")),
        }

        def together(name: str, sources: list[Path]) -> Path:
            """Write one source of several: most of the work is in the headers that they share."""
            file = self.folder / "source" / self.name / f"{name}{sources[0].suffix}"
            file.write_text("".join(f'#include "{source}"\n' for source in sources))
            return file

        def compiled(source: Path) -> Path:
            target = source.with_suffix(source.suffix + ".o")
            program = ["g++", "-std=c++17"] if source.suffix == ".cpp" else ["gcc"]
            _run(
                *program, "-O0", "-fPIC", "-w", "-c", source, "-o", target,
                *(f"-I{folder}" for folder in include),
            )  # fmt: skip
            return target

        # Names of types stand in each description again: these are compiled one by one.
        parts = [together("own", own), *described]
        parts += [together(name, found) for name, found in supports.items()]
        with ThreadPoolExecutor(2) as pool:
            compiled_parts = list(pool.map(compiled, parts))
        own, objects = (
            compiled_parts[:-2],
            {name: [part] for name, part in zip(supports, compiled_parts[-2:], strict=True)},
        )
        (entry,) = python.glob("*.ep.rosidl_typesupport_c.c")
        library = self.folder / f"lib{self.name}.so"
        linked = [
            f"-L{LIBRARIES}", f"-L{self.folder}", f"-Wl,-rpath,{LIBRARIES}",
            f"-Wl,-rpath,{self.folder}", "-Wl,--allow-shlib-undefined",
            *(f"-l{name}" for name in (
                "rosidl_runtime_c", "rosidl_typesupport_c", "rosidl_typesupport_fastrtps_c",
                "rosidl_typesupport_fastrtps_cpp", "rosidl_typesupport_introspection_c", "rcutils",
                "fastcdr",
            )),
            *(
                f"-l{package}__rosidl_{part}"
                for package in KNOWN
                for part in ("generator_c", "generator_py", "typesupport_fastrtps_c",
                             "typesupport_introspection_c", "typesupport_c")
            ),
            *(f"-l{name}" for package in self.needs for name in
              (package, *(f"{package}__{support}" for support in SUPPORTS))),
        ]  # fmt: skip
        # rosidl finds the two by these names, among what the process has loaded already.
        for name, parts in objects.items():
            file = f"lib{self.name}__{name}.so"
            _run("g++", "-shared", f"-Wl,-soname,{file}", "-o", self.folder / file, *parts, *linked)
        ours = (f"-l{self.name}__{name}" for name in SUPPORTS)
        _run("g++", "-shared", "-o", library, *own, "-Wl,--no-as-needed", *ours, *linked)
        module = python / f"{self.name}_s__rosidl_typesupport_c.so"
        _run(
            "gcc", "-w", "-fPIC", "-shared", "-o", module, entry,
            *(f"-I{folder}" for folder in include), f"-l{self.name}", *linked,
        )  # fmt: skip


def _run(*words: str | Path) -> None:
    done = subprocess.run(
        [str(word) for word in words], capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(map(str, words))}\n{done.stderr[-3000:]}")
