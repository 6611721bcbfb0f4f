// Starts the interactive character of a report. Everything comes from the page itself; nothing is fetched.
import { Controls } from "./controls.js";
import { loadCharacter } from "./character.js";
import { SkeletonOverlay } from "./skeleton.js";
import { Stage } from "./stage.js";

const root = document.querySelector("[data-character]");

function bytes(id) {
  const text = document.getElementById(id)?.textContent.trim();
  return text ? Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)) : null;
}

function save(content, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(new Blob([content], { type: "model/gltf-binary" }));
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

async function start() {
  const canvas = root.querySelector("canvas");
  const glb = bytes("character-glb"), base = bytes("character-base");
  const stage = new Stage(canvas);
  const image = base && URL.createObjectURL(new Blob([base], { type: "image/jpeg" }));
  const character = await loadCharacter(glb.buffer, image);
  stage.scene.add(character.scene);
  const accent = getComputedStyle(document.documentElement).getPropertyValue("--accent").trim() || "#1f6f8b";
  const skeleton = new SkeletonOverlay(character.bones, accent);
  stage.scene.add(skeleton.group);

  const restart = () => {
    character.apply(controls.clip, controls.time);
    const facing = character.bones[0].matrixWorld.elements;
    stage.frame(character.root, character.height, Math.atan2(facing[8], facing[10]));
  };
  let dirty = true;
  const controls = new Controls(root, character, {
    changed: () => (dirty = true),
    restarted: () => restart(),
    showSkeleton: (shown) => (skeleton.group.visible = shown),
    spin: (turning) => (stage.controls.autoRotate = turning),
    save: () => save(glb, root.dataset.file),
  });
  stage.controls.addEventListener("change", () => (dirty = true));
  restart();

  let pressed = null;
  canvas.addEventListener("pointerdown", (event) => (pressed = [event.clientX, event.clientY]));
  canvas.addEventListener("pointerup", (event) => {
    const moved = pressed && Math.hypot(event.clientX - pressed[0], event.clientY - pressed[1]);
    if (moved === null || moved > 6 || !skeleton.group.visible) return;
    const box = canvas.getBoundingClientRect();
    const joint = skeleton.nearest(event.clientX - box.left, event.clientY - box.top, stage.camera, box.width, box.height);
    if (joint !== null) controls.choose(joint);
  });

  const draw = () => {
    character.apply(controls.clip, controls.time);
    stage.follow(character.root);
    skeleton.update(controls.joint);
    stage.render();
    dirty = false;
  };
  let visible = true, last = performance.now(), size = "";
  new IntersectionObserver((entries) => (visible = entries.at(-1).isIntersecting)).observe(canvas);
  const frame = (now) => {
    requestAnimationFrame(frame);
    const seconds = Math.min((now - last) / 1000, 0.1);
    last = now;
    if (!visible) return;
    controls.advance(seconds);
    stage.controls.update();
    const shape = `${canvas.width}x${canvas.height}`;
    if (controls.playing || stage.controls.autoRotate || dirty || shape !== size) draw();
    size = shape;
  };
  requestAnimationFrame(frame);
  draw();
  root.classList.add("ready");
  // For tests, and for whoever wants to script the character from the console.
  globalThis.twofoldCharacter = { character, controls, stage, skeleton, draw };
}

// Some browsers play no video from a data address, but all do from a blob.
for (const video of document.querySelectorAll("video[src^='data:']")) {
  fetch(video.src)
    .then((answer) => answer.blob())
    .then((content) => (video.src = URL.createObjectURL(content)))
    .catch(() => {});
}

if (root) {
  start().catch((error) => {
    root.classList.add("failed");
    root.querySelector("[data-role=problem]").textContent =
      `The interactive character needs WebGL, which this browser does not offer here (${error.message}).`;
  });
}
