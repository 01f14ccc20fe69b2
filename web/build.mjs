// Bundles the page into the viewer's package, where the wheel takes it from.
import { build } from "esbuild";
import { cp, mkdir, rename, rm } from "node:fs/promises";
import { dirname, join } from "node:path";
import { fileURLToPath } from "node:url";

const here = dirname(fileURLToPath(import.meta.url));
const out = process.argv[2] ?? join(here, "../services/viewer/rhot_viewer/static");
const fresh = `${out}.new`;

await rm(fresh, { recursive: true, force: true });
await mkdir(fresh, { recursive: true });
await build({
  entryPoints: [join(here, "src/main.js")],
  bundle: true,
  minify: true,
  format: "esm",
  target: "es2022",
  legalComments: "inline",
  logLevel: "warning",
  outfile: join(fresh, "grasp.js"),
});
for (const name of ["index.html", "style.css"]) await cp(join(here, "src", name), join(fresh, name));
// Whole or not at all: a server may be reading.
await rm(out, { recursive: true, force: true });
await rename(fresh, out);
