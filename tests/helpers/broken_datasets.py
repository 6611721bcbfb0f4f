"""Ways to damage a data set that `datasets` wrote: functions of its folder (or HDF5 file)."""

import json
import pickle
import shutil

import datasets
import numpy as np


def objects(folder, name, edit):
    """Changes the dictionary in an npy file."""
    content = np.load(folder / name, allow_pickle=True).item()
    np.save(folder / name, edit(content) or content)


def annotate(edit):
    return lambda folder: objects(folder, "annots.npy", edit)


def parameter(name="new_params/0.npy", **changes):
    def edit(content):
        for key, value in changes.items():
            if value is None:
                del content[key]
            else:
                content[key] = value(content[key]) if callable(value) else value

    return lambda folder: objects(folder, name, edit)


def pickled(name, edit):
    def change(folder):
        content = pickle.loads((folder / name).read_bytes())  # noqa: TID251 - the test has written it
        first = content[sorted(content)[0]]
        edit(content, first)
        (folder / name).write_bytes(pickle.dumps(content))

    return change


def array(name, edit):
    def change(folder):
        np.save(folder / name, edit(np.load(folder / name)))

    return change


def archive(name, edit):
    def change(folder):
        with np.load(folder / name) as stored:
            content = dict(stored)
        edit(content)
        np.savez(folder / name, **content)

    return change


def cut(name, share=0.5):
    def change(folder):
        raw = (folder / name).read_bytes()
        (folder / name).write_bytes(raw[: int(len(raw) * share)])

    return change


def text(name, edit):
    def change(folder):
        content = json.loads((folder / name).read_text())
        edit(content, content[sorted(content)[0]])
        (folder / name).write_text(json.dumps(content))

    return change


def gone(*names):
    def change(folder):
        for name in names:
            place = folder / name
            shutil.rmtree(place) if place.is_dir() else place.unlink()

    return change


def hdf5(edit, part="training"):
    def change(file):
        import h5py

        with h5py.File(file.with_name(f"377_{part}.h5"), "r+") as stored:
            edit(stored)

    return change


def again(name, value, **options):
    """Writes an array of an HDF5 file anew."""

    def edit(stored):
        found = stored[name][()]
        del stored[name]
        stored.create_dataset(name, data=value(found) if callable(value) else value, **options)

    return edit


def linked(stored):
    import h5py

    del stored["poses"]
    stored["poses"] = h5py.ExternalLink("elsewhere.h5", "poses")


def virtual(stored):
    import h5py

    shape = stored["poses"].shape
    del stored["poses"]
    layout = h5py.VirtualLayout(shape, "f4")
    layout[:] = h5py.VirtualSource("elsewhere.h5", "poses", shape)
    stored.create_virtual_dataset("poses", layout)


def spoilt(index, value):
    def edit(found):
        found = np.array(found)
        found.flat[index] = value
        return found

    return edit


class Hostile:
    def __reduce__(self):
        return (exec, ("raise SystemExit('this was run')",))


def only_old(folder):
    shutil.rmtree(folder / "new_params")


def old_as_new(folder):
    only_old(folder)
    shutil.copytree(folder / "params", folder / "new_params")


def old_as_new_alone(folder):
    old_as_new(folder)
    shutil.rmtree(folder / "params")


def set_cams(key, value):
    return annotate(lambda c: c["cams"].__setitem__(key, value(c["cams"][key])))


def set_mesh(key, value):
    return pickled("mesh_infos.pkl", lambda _, first: first.__setitem__(key, value(first[key])))


def set_camera(key, value):
    return pickled("cameras.pkl", lambda _, first: first.__setitem__(key, value(first[key])))


def smaller_image(folder):
    datasets.save_image(folder / "Camera_B1" / "000001.jpg", np.zeros((16, 16, 3), np.uint8))


def smaller_mask(folder):
    datasets.save_image(folder / "mask" / "Camera_B1" / "000001.png", np.ones((16, 16), np.uint8))
