import { defineConfig } from "vite";

// The server hands out what is built at /app/; names carry a digest of the content, so that they may be cached forever.
export default defineConfig({
  base: "/app/",
  build: {
    outDir: "../page",
    emptyOutDir: true,
    assetsInlineLimit: 0, // data: addresses would need an exception in the content security policy
    modulePreload: { polyfill: false },
    chunkSizeWarningLimit: 1000,
    target: "es2022",
  },
});
