// Prints the official validator's report of each glTF file as one line of JSON.
const fs = require("fs");
const validator = require("gltf-validator");

(async () => {
  for (const file of process.argv.slice(2)) {
    const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(file)), { maxIssues: 100 });
    console.log(JSON.stringify({ file, issues: report.issues }));
  }
})();
