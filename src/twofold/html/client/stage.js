// Where the character stands: renderer, camera, light, floor; follows the reader's colour scheme and the page's width.
import {
  CanvasTexture, Color, DirectionalLight, HemisphereLight, Mesh, MeshBasicMaterial, PerspectiveCamera, PlaneGeometry,
  Scene, SRGBColorSpace, Vector3, WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";

const FLOOR = 6; // edge of the floor, metres

export class Stage {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.scene = new Scene();
    this.camera = new PerspectiveCamera(30, 1, 0.05, 60);
    this.scene.add(new HemisphereLight(0xffffff, 0xa8a8b0, 2.1));
    this.light = new DirectionalLight(0xffffff, 1.5);
    this.scene.add(this.light, this.light.target);
    this.controls = new OrbitControls(this.camera, canvas);
    this.controls.enableDamping = true;
    this.controls.minDistance = 0.6;
    this.controls.maxDistance = 12;
    this.controls.maxPolarAngle = 0.53 * Math.PI;
    // A finger that goes up or down scrolls the page; two fingers zoom.
    canvas.style.touchAction = "pan-y";
    this.floor = new Mesh(new PlaneGeometry(FLOOR, FLOOR), new MeshBasicMaterial({ transparent: true, depthWrite: false }));
    this.floor.rotation.x = -Math.PI / 2;
    this.floor.renderOrder = -1;
    this.scene.add(this.floor);
    this.shadow = new Mesh(
      new PlaneGeometry(1.3, 1.3),
      new MeshBasicMaterial({ map: shadowTexture(), transparent: true, depthWrite: false, color: 0x000000 }),
    );
    this.shadow.rotation.x = -Math.PI / 2;
    this.shadow.position.y = 0.003;
    this.scene.add(this.shadow);
    this.followed = new Vector3();
    this.adaptScheme();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.adaptScheme());
    new ResizeObserver(() => this.resize()).observe(canvas.parentElement);
    this.resize();
  }

  adaptScheme() {
    const style = getComputedStyle(document.documentElement);
    const line = new Color(style.getPropertyValue("--faint").trim() || "#888");
    this.floor.material.map?.dispose();
    this.floor.material.map = floorTexture(`#${line.getHexString()}`);
    this.floor.material.needsUpdate = true;
    const dark = matchMedia("(prefers-color-scheme: dark)").matches;
    this.shadow.material.opacity = dark ? 0.55 : 0.3;
  }

  resize() {
    const { clientWidth: width, clientHeight: height } = this.canvas.parentElement;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.camera.aspect = width / height;
    this.camera.updateProjectionMatrix();
  }

  // Puts the camera in front of somebody `height` metres tall, standing at `root`, turned by `yaw`.
  frame(root, height, yaw) {
    const fov = (this.camera.fov * Math.PI) / 180;
    const across = 2 * Math.atan(Math.tan(fov / 2) * Math.min(this.camera.aspect, 1));
    const away = (0.68 * height) / Math.tan(across / 2);
    this.controls.target.set(root.x, 0.52 * height, root.z);
    const angle = yaw + 0.4;
    this.camera.position.set(root.x + away * Math.sin(angle), 0.68 * height, root.z + away * Math.cos(angle));
    this.followed.set(root.x, 0, root.z);
    this.controls.update();
  }

  // The camera goes along with the person.
  follow(root) {
    const dx = root.x - this.followed.x, dz = root.z - this.followed.z;
    for (const point of [this.camera.position, this.controls.target]) {
      point.x += dx;
      point.z += dz;
    }
    this.followed.set(root.x, 0, root.z);
    this.shadow.position.set(root.x, 0.003, root.z);
    // The floor's pattern repeats every half metre, so it can follow in steps.
    this.floor.position.set(Math.round(root.x * 2) / 2, 0, Math.round(root.z * 2) / 2);
  }

  render() {
    this.controls.update();
    this.light.position.copy(this.camera.position).y += 2;
    this.light.target.position.copy(this.controls.target);
    this.renderer.render(this.scene, this.camera);
  }
}

function painted(size, paint) {
  const canvas = document.createElement("canvas");
  canvas.width = canvas.height = size;
  paint(canvas.getContext("2d"), size);
  const texture = new CanvasTexture(canvas);
  texture.colorSpace = SRGBColorSpace;
  texture.anisotropy = 4;
  return texture;
}

function floorTexture(line) {
  return painted(1024, (context, size) => {
    context.strokeStyle = line;
    context.lineWidth = 2;
    for (let place = 0; place <= size; place += size / (2 * FLOOR)) {
      context.strokeRect(place, -5, 0, size + 10);
      context.strokeRect(-5, place, size + 10, 0);
    }
    const fade = context.createRadialGradient(size / 2, size / 2, 0, size / 2, size / 2, 0.48 * size);
    fade.addColorStop(0, "rgba(0,0,0,0.5)");
    fade.addColorStop(1, "rgba(0,0,0,0)");
    context.globalCompositeOperation = "destination-in";
    context.fillStyle = fade;
    context.fillRect(0, 0, size, size);
  });
}

function shadowTexture() {
  return painted(128, (context, size) => {
    const fade = context.createRadialGradient(size / 2, size / 2, 0, size / 2, size / 2, size / 2);
    fade.addColorStop(0, "rgba(255,255,255,1)");
    fade.addColorStop(0.3, "rgba(255,255,255,0.55)");
    fade.addColorStop(1, "rgba(255,255,255,0)");
    context.fillStyle = fade;
    context.fillRect(0, 0, size, size);
  });
}
