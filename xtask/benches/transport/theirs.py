"""The other side of `cargo xtask bench transport`: Mitsuba 3 on the scenes of assets/fixtures/transport/mitsuba.

    pip install mitsuba numpy
    python3 xtask/benches/transport/theirs.py assets/fixtures/transport/mitsuba OUT.json

Every scene is rendered in several independent rounds on one thread, in each variant and with each setting. Written: processor seconds
of a sample of one pixel, and the mean over the film of the variance of one sample, per channel. Their product is what an error costs.
"""
import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

ROUNDS = 5
RESOLUTION = 64
# Samples per pixel of a round; wide machines want many at once.
VARIANTS = {"scalar_rgb": 32, "llvm_ad_rgb": 256}
RIG = [[-1, -1, -1], [1, 0.5, -0.5], [0.3, -1, 0.4], [-0.5, 0.2, 1]]
INTEGRATORS = {
    "volpath, roulette off": {"type": "volpath", "max_depth": 4096, "rr_depth": 100000, "hide_emitters": True},
    "volpath": {"type": "volpath", "max_depth": -1, "hide_emitters": True},
    "volpathmis": {"type": "volpathmis", "max_depth": -1, "hide_emitters": True},
}


def scene(mi, folder, s, integrator, spp):
    t = mi.ScalarTransform4f
    camera = s["camera"]
    if s["shape"].startswith("unit sphere"):
        shape = {"type": "sphere"}
    else:
        shape = {"type": "ply", "filename": str(folder / Path(s["shape"]).name), "face_normals": True}
    if s["boundary"][0] == "null":
        bsdf = {"type": "null"}
    else:
        bsdf = {
            "type": "roughdielectric", "distribution": "ggx", "alpha": s["boundary"][2],
            "int_ior": s["boundary"][1], "ext_ior": 1.0,
        }
    def three(v):
        return v if isinstance(v, list) else [v] * 3
    medium = {
        "type": "homogeneous",
        "albedo": {"type": "rgb", "value": three(s["albedo"])},
        "sigma_t": s["sigma_t"],
        "phase": {"type": "hg", "g": s["g"]} if s["g"] != 0 else {"type": "isotropic"},
    }
    return mi.load_dict({
        "type": "scene",
        "integrator": integrator,
        "sensor": {
            "type": "perspective", "fov": camera["fov_x_deg"], "fov_axis": "x",
            "to_world": t().look_at(origin=camera["origin"], target=camera["target"], up=camera["up"]),
            "film": {
                "type": "hdrfilm", "width": camera["res"], "height": camera["res"], "rfilter": {"type": "box"},
                "pixel_format": "rgb", "component_format": "float32",
            },
            "sampler": {"type": "independent", "sample_count": spp},
        },
        "object": {**shape, "bsdf": bsdf, "interior": medium},
        "light": {
            "type": "directional", "direction": s["light_travel_direction_unnormalised"],
            "irradiance": {"type": "rgb", "value": three(s["irradiance"])},
        },
    })


def measure(variant, spp, folder):
    """Rows of one variant; printed as they come."""
    import drjit as dr
    import mitsuba as mi

    mi.set_variant(variant)
    dr.set_thread_count(1)
    scenes = json.loads((folder / "refs.json").read_text())
    for name in ("sphere_null_front", "mesh_null_front"):
        # Lights of a rig, one picture each; `main.rs` has the same list.
        for k, travel in enumerate(RIG):
            scenes[f"{name}/{k}"] = {**json.loads(json.dumps(scenes[name])), "light_travel_direction_unnormalised": travel}
    for name, s in scenes.items():
        if "light_travel_direction_unnormalised" not in s:
            continue
        s["camera"]["res"] = RESOLUTION
        for label, integrator in INTEGRATORS.items():
            if "/" in name and label != "volpath":
                continue
            built = scene(mi, folder, s, integrator, spp)
            np.array(mi.render(built, spp=spp, seed=999))
            seconds, pictures = [], []
            for r in range(ROUNDS):
                start = time.process_time()
                pictures.append(np.array(mi.render(built, spp=spp, seed=r)).astype(np.float64))
                seconds.append(time.process_time() - start)
            stack = np.stack(pictures)
            each = float(np.median(seconds)) / (RESOLUTION * RESOLUTION * spp)
            variance = (stack.var(axis=0, ddof=1).mean(axis=(0, 1)) * spp).tolist()
            row = {
                "scene": name, "variant": variant, "integrator": label, "seconds_per_sample": each,
                "variance_per_sample": variance, "mean": stack.mean(axis=(0, 1, 2)).tolist(),
                "version": mi.__version__,
            }
            print(json.dumps(row), flush=True)


def main():
    folder, out = Path(sys.argv[1]), Path(sys.argv[2])
    if len(sys.argv) > 3:
        return measure(sys.argv[3], int(sys.argv[4]), folder)
    rows = []
    for variant, spp in VARIANTS.items():
        # A process of its own: a variant that the machine cannot run may end it.
        command = [sys.executable, __file__, str(folder), str(out), variant, str(spp)]
        done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
        rows += [json.loads(line) for line in done.stdout.splitlines() if line.startswith("{")]
        if done.returncode != 0:
            print(f"{variant} ended with {done.returncode}; what it measured before is kept", file=sys.stderr)
    out.write_text(json.dumps(rows, indent=1) + "\n")


main()
