// The person: a skinned mesh with morph targets, its motions, and a pose that the reader adds to them.
import { Box3, Euler, LoadingManager, Quaternion, SRGBColorSpace, TextureLoader, Vector3 } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const DEGREE = Math.PI / 180;

export async function loadCharacter(glb, baseImage) {
  const gltf = await new GLTFLoader(new LoadingManager()).parseAsync(glb, "");
  const character = new Character(gltf);
  if (baseImage) await character.addBase(baseImage);
  return character;
}

class Character {
  constructor(gltf) {
    this.scene = gltf.scene;
    this.clips = gltf.animations.map((clip) => new Clip(clip));
    this.scene.traverse((node) => {
      if (node.isSkinnedMesh) this.mesh = node;
    });
    // What moves is not where its rest pose says.
    this.mesh.frustumCulled = false;
    this.bones = this.mesh.skeleton.bones;
    this.byName = new Map(this.bones.map((bone) => [bone.name, bone]));
    this.rest = this.bones.map((bone) => ({ place: bone.position.clone(), turn: bone.quaternion.clone() }));
    this.offsets = this.bones.map(() => [0, 0, 0]);
    this.full = this.mesh.material;
    this.base = null;
    // The geometry's own box also holds all that morph targets can do together.
    const box = new Box3().setFromBufferAttribute(this.mesh.geometry.attributes.position);
    this.height = box.max.y - box.min.y;
    this.root = new Vector3();
    this.euler = new Euler();
    this.turn = new Quaternion();
  }

  // The same surface in the colours of the base branch.
  async addBase(address) {
    const texture = await new TextureLoader().loadAsync(address);
    texture.flipY = false;
    texture.colorSpace = SRGBColorSpace;
    this.base = this.full.clone();
    this.base.map = texture;
  }

  showColors(name) {
    this.mesh.material = name === "base" && this.base ? this.base : this.full;
  }

  // Degrees about the joint's own axes, on top of the motion.
  setOffset(joint, axis, degrees) {
    this.offsets[joint][axis] = degrees;
  }

  resetOffsets() {
    for (const offset of this.offsets) offset.fill(0);
  }

  // The pose at a time of a clip (null: the rest pose), with the offsets added.
  apply(clip, time) {
    this.bones.forEach((bone, index) => {
      bone.position.copy(this.rest[index].place);
      bone.quaternion.copy(this.rest[index].turn);
    });
    this.mesh.morphTargetInfluences?.fill(0);
    clip?.apply(this, time);
    this.bones.forEach((bone, index) => {
      const [x, y, z] = this.offsets[index];
      if (x || y || z) bone.quaternion.multiply(this.turn.setFromEuler(this.euler.set(x * DEGREE, y * DEGREE, z * DEGREE)));
    });
    this.scene.updateMatrixWorld(true);
    this.bones[0].getWorldPosition(this.root);
  }

  // World transforms of the joints, 16 numbers each, by columns.
  transforms() {
    return this.bones.map((bone) => bone.matrixWorld.toArray());
  }
}

class Clip {
  constructor(clip) {
    this.name = clip.name;
    this.duration = clip.duration;
    this.tracks = clip.tracks.map((track) => {
      const cut = track.name.lastIndexOf(".");
      return { node: track.name.slice(0, cut), property: track.name.slice(cut + 1), values: track.createInterpolant() };
    });
  }

  apply(character, time) {
    for (const { node, property, values } of this.tracks) {
      const found = values.evaluate(time);
      if (property === "morphTargetInfluences") {
        found.forEach((value, index) => (character.mesh.morphTargetInfluences[index] = value));
      } else {
        character.byName.get(node)?.[property].fromArray(found);
      }
    }
  }
}
