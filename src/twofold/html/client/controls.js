// Binds the page's own form elements (templates/character.html) to the character.
export class Controls {
  constructor(root, character, actions) {
    this.root = root;
    this.character = character;
    this.actions = actions;
    this.playing = !matchMedia("(prefers-reduced-motion: reduce)").matches && character.clips.length > 0;
    this.clip = character.clips[0] ?? null;
    this.time = 0;
    this.joint = 0;
    this.limits = JSON.parse(document.getElementById("character-limits").textContent);
    this.find = (name) => root.querySelector(`[data-role="${name}"]`);
    this.bindMotion();
    this.bindShown();
    this.bindPose();
    root.addEventListener("input", () => actions.changed());
    this.choose(0);
    this.showState();
  }

  bindMotion() {
    const motion = this.find("motion"), play = this.find("play"), scrub = this.find("scrub");
    motion.addEventListener("change", () => {
      this.clip = this.character.clips[Number(motion.value)] ?? null;
      this.time = 0;
      this.playing = this.clip !== null;
      this.actions.restarted();
      this.showState();
    });
    play.addEventListener("click", () => {
      if (!this.clip) {
        motion.value = "0";
        motion.dispatchEvent(new Event("change"));
        return;
      }
      this.playing = !this.playing;
      this.showState();
    });
    scrub.addEventListener("input", () => {
      this.playing = false;
      if (this.clip) this.time = (Number(scrub.value) / 1000) * this.clip.duration;
      this.showState();
    });
  }

  bindShown() {
    for (const button of this.root.querySelectorAll("[name=character-colors]")) {
      button.addEventListener("change", () => this.character.showColors(button.value));
    }
    this.find("skeleton").addEventListener("change", (event) => this.actions.showSkeleton(event.target.checked));
    this.find("spin").addEventListener("change", (event) => this.actions.spin(event.target.checked));
    this.find("view").addEventListener("click", () => this.actions.restarted());
    this.find("save").addEventListener("click", () => this.actions.save());
  }

  bindPose() {
    const joint = this.find("joint");
    this.sliders = [...this.root.querySelectorAll("[data-axis]")];
    joint.addEventListener("change", () => this.choose(Number(joint.value)));
    for (const slider of this.sliders) {
      slider.addEventListener("input", () => {
        this.character.setOffset(this.joint, Number(slider.dataset.axis), Number(slider.value));
        this.showOffset();
      });
    }
    this.find("reset-joint").addEventListener("click", () => {
      this.character.offsets[this.joint].fill(0);
      this.choose(this.joint);
    });
    this.find("reset-pose").addEventListener("click", () => {
      this.character.resetOffsets();
      this.choose(this.joint);
    });
  }

  choose(joint) {
    this.joint = joint;
    this.find("joint").value = String(joint);
    for (const slider of this.sliders) {
      [slider.min, slider.max] = this.limits[joint][Number(slider.dataset.axis)];
    }
    this.sliders.forEach((slider) => (slider.value = String(this.character.offsets[joint][Number(slider.dataset.axis)])));
    this.showOffset();
    this.actions.changed();
  }

  showOffset() {
    for (const slider of this.sliders) slider.nextElementSibling.textContent = `${slider.value}\u00b0`;
  }

  advance(seconds) {
    if (!this.playing || !this.clip) return;
    const speed = Number(this.find("speed").value);
    this.time = (this.time + speed * seconds) % Math.max(this.clip.duration, 1e-3);
    this.find("scrub").value = String((1000 * this.time) / Math.max(this.clip.duration, 1e-3));
  }

  showState() {
    const play = this.find("play");
    play.setAttribute("aria-pressed", String(this.playing));
    play.querySelector("span").textContent = this.playing ? "Pause" : "Play";
    this.find("scrub").disabled = this.clip === null;
    this.actions.changed();
  }
}
