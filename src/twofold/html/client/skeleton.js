// The skeleton as lines and points over the surface; a joint can be chosen by a click or a tap.
import {
  BufferAttribute, BufferGeometry, CanvasTexture, Group, LineBasicMaterial, LineSegments, Points, PointsMaterial, Vector3,
} from "three";

const REACH = 26; // of a finger, pixels

export class SkeletonOverlay {
  constructor(bones, accent) {
    this.bones = bones;
    this.pairs = bones.map((bone, index) => [index, bones.indexOf(bone.parent)]).filter(([, parent]) => parent >= 0);
    this.lines = new BufferAttribute(new Float32Array(this.pairs.length * 6), 3);
    this.places = new BufferAttribute(new Float32Array(bones.length * 3), 3);
    this.chosen = new BufferAttribute(new Float32Array(3), 3);
    const over = { depthTest: false, transparent: true };
    const dot = { sizeAttenuation: false, map: disc(), alphaTest: 0.3, ...over };
    this.group = new Group();
    this.group.add(
      new LineSegments(geometry(this.lines), new LineBasicMaterial({ color: accent, opacity: 0.9, ...over })),
      new Points(geometry(this.places), new PointsMaterial({ color: accent, size: 8, ...dot })),
      new Points(geometry(this.chosen), new PointsMaterial({ color: 0xf0802a, size: 14, ...dot })),
    );
    for (const part of this.group.children) {
      part.frustumCulled = false;
      part.renderOrder = 2;
    }
    this.group.visible = false;
    this.point = new Vector3();
  }

  update(joint) {
    if (!this.group.visible) return;
    this.bones.forEach((bone, index) => {
      bone.getWorldPosition(this.point).toArray(this.places.array, 3 * index);
    });
    this.pairs.forEach((pair, row) => {
      pair.forEach((index, end) => {
        for (let axis = 0; axis < 3; axis++) this.lines.array[6 * row + 3 * end + axis] = this.places.array[3 * index + axis];
      });
    });
    this.chosen.array.set(this.places.array.subarray(3 * joint, 3 * joint + 3));
    for (const attribute of [this.lines, this.places, this.chosen]) attribute.needsUpdate = true;
  }

  // The joint nearest to a place of the canvas (CSS pixels), or null.
  nearest(x, y, camera, width, height) {
    let best = null, least = REACH;
    this.bones.forEach((bone, index) => {
      bone.getWorldPosition(this.point).project(camera);
      const away = Math.hypot(((this.point.x + 1) / 2) * width - x, ((1 - this.point.y) / 2) * height - y);
      if (away < least) [best, least] = [index, away];
    });
    return best;
  }
}

function disc() {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = 32;
  const context = canvas.getContext("2d");
  context.fillStyle = "#fff";
  context.arc(16, 16, 15, 0, 2 * Math.PI);
  context.fill();
  return new CanvasTexture(canvas);
}

function geometry(positions) {
  return new BufferGeometry().setAttribute("position", positions);
}
