// Bundles the character's client and three.js into ../vendor/character.js, with licences and versions beside it.
import { readFile, writeFile } from "node:fs/promises";
import { createHash } from "node:crypto";
import { build, version as esbuild } from "esbuild";

const banner = (three) =>
  `/*! twofold's character client (MIT, source in html/client), bundled with three.js ${three} ` +
  "(MIT, (c) three.js authors; see LICENSE.three.txt) */";

const { version: three } = JSON.parse(await readFile("node_modules/three/package.json", "utf8"));
const result = await build({
  entryPoints: ["main.js"],
  bundle: true,
  minify: true,
  format: "iife",
  target: ["es2020", "safari15"],
  legalComments: "none",
  charset: "ascii",
  banner: { js: banner(three) },
  write: false,
});
const script = result.outputFiles[0].text;
// The script stands inside an HTML page, where this would end it.
if (/<\/script|<!--/i.test(script)) throw new Error("the bundle holds text that ends a script element");
await writeFile("../vendor/character.js", script);
await writeFile("../vendor/LICENSE.three.txt", await readFile("node_modules/three/LICENSE"));
const sources = ["main.js", "stage.js", "character.js", "skeleton.js", "controls.js", "build.mjs", "package-lock.json"];
const sha256 = (data) => createHash("sha256").update(data).digest("hex");
const made = {
  script: "character.js",
  bytes: Buffer.byteLength(script),
  sha256: sha256(script),
  packages: { three: { version: three, license: "MIT" }, esbuild: { version: esbuild, license: "MIT, not part of the script" } },
  sources: Object.fromEntries(await Promise.all(sources.map(async (name) => [name, sha256(await readFile(name))]))),
};
await writeFile("../vendor/VERSIONS.json", JSON.stringify(made, null, 2) + "\n");
console.log(`vendor/character.js: ${made.bytes} bytes, three.js ${three}`);
