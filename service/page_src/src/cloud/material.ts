// The shaders: points that are as large as their spacing, moved between rough and refined poses, and shaded by depth.

import { DataTexture, FloatType, GLSL3, NearestFilter, RGBAFormat, RGIntegerFormat, ShaderMaterial, UnsignedByteType, UnsignedIntType, Vector2 } from "three";

export const NODES_WIDTH = 512;
export const SCANS_WIDTH = 512;

const POINT_VERTEX = /* glsl */ `
precision highp float;
precision highp int;
precision highp usampler2D;
in vec3 rgb;
in float value;
in float scan;
uniform usampler2D nodes;      // per shown node: mask of shown children and place of the first of them; spacing (bits of a float)
uniform sampler2D rough;       // rough from refined position, three rows per scan
uniform sampler2D palette;
uniform int nodePlace;
uniform float nodeEdge;
uniform vec3 nodeLow;
uniform float pixelsPerRadian;
uniform float sizeFactor;
uniform float toRough;
uniform int hasScans;
uniform int onlyColored;      // in rgb mode, where value is the number of views
uniform int colorBy;           // 0: rgb, 1: height, 2: value, 3: value as a name
uniform vec2 range;
out vec3 shade;

uvec2 nodeAt(int place) { return texelFetch(nodes, ivec2(place % ${String(NODES_WIDTH)}, place / ${String(NODES_WIDTH)}), 0).rg; }

// how far apart points are in the deepest node that is shown here
float spacingHere(vec3 inside) {
  int place = nodePlace;
  float edge = nodeEdge;
  for (int i = 0; i < 16; i++) {
    uvec2 both = nodeAt(place);
    uint entry = both.x;
    edge *= 0.5;
    ivec3 corner = ivec3(greaterThanEqual(inside, vec3(edge)));
    uint child = uint(corner.x * 4 + corner.y * 2 + corner.z);
    if (((entry >> child) & 1u) == 0u) return uintBitsToFloat(both.y);
    uint before = entry & ((1u << child) - 1u) & 255u;
    int number = 0;
    for (int b = 0; b < 8; b++) number += int((before >> uint(b)) & 1u);
    place = int(entry >> 8u) + number;
    inside -= vec3(corner) * edge;
  }
  return uintBitsToFloat(nodeAt(place).y);
}

vec4 row(int scanIndex, int r) {
  int at = scanIndex * 3 + r;
  return texelFetch(rough, ivec2(at % ${String(SCANS_WIDTH)}, at / ${String(SCANS_WIDTH)}), 0);
}

void main() {
  vec3 refined = position + nodeLow;
  vec3 place = refined;
  if (hasScans == 1 && toRough > 0.0) {
    int s = int(scan + 0.5);
    vec4 h = vec4(refined, 1.0);
    place = mix(refined, vec3(dot(row(s, 0), h), dot(row(s, 1), h), dot(row(s, 2), h)), toRough);
  }
  vec4 view = modelViewMatrix * vec4(place, 1.0);
  gl_Position = projectionMatrix * view;
  float spacing = spacingHere(position);
  gl_PointSize = clamp(1.5 * sizeFactor * spacing * pixelsPerRadian / max(-view.z, 0.01), 1.5, 40.0);
  if (colorBy == 0) {
    shade = rgb;
    if (onlyColored == 1 && value < 0.5) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  }
  else {
    float t = colorBy == 1 ? refined.z : value;
    float x = colorBy == 3 ? mod(value, 256.0) : 255.0 * clamp((t - range.x) / max(range.y - range.x, 1e-9), 0.0, 1.0);
    shade = t > 1e29 ? vec3(0.5) : texture(palette, vec2((x + 0.5) / 256.0, 0.5)).rgb;
  }
}`;

const POINT_FRAGMENT = /* glsl */ `
precision highp float;
in vec3 shade;
out vec4 color;
void main() {
  vec2 away = gl_PointCoord - 0.5;
  if (dot(away, away) > 0.25) discard;
  color = vec4(shade, 1.0);
}`;

export function pointMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: POINT_VERTEX,
    fragmentShader: POINT_FRAGMENT,
    uniforms: {
      nodes: { value: null }, rough: { value: null }, palette: { value: null },
      nodePlace: { value: 0 }, nodeEdge: { value: 1 }, nodeLow: { value: [0, 0, 0] },
      pixelsPerRadian: { value: 1 }, sizeFactor: { value: 1 },
      toRough: { value: 0 }, hasScans: { value: 0 }, onlyColored: { value: 0 }, colorBy: { value: 0 }, range: { value: new Vector2(0, 1) },
    },
  });
}

const SCREEN_VERTEX = /* glsl */ `
out vec2 uv2;
void main() { uv2 = position.xy * 0.5 + 0.5; gl_Position = vec4(position.xy, 0.0, 1.0); }`;

// Eye-dome lighting: what lies behind its neighbors is darker, so that edges and depth can be seen.
const SCREEN_FRAGMENT = /* glsl */ `
precision highp float;
in vec2 uv2;
uniform sampler2D picture;
uniform sampler2D depth;
uniform vec2 pixel;
uniform vec2 nearFar;
uniform float strength;
out vec4 color;
float logDepth(vec2 at) {
  float z = texture(depth, at).r * 2.0 - 1.0;
  return z >= 1.0 ? 1e3 : log2(2.0 * nearFar.x * nearFar.y / (nearFar.y + nearFar.x - z * (nearFar.y - nearFar.x)));
}
void main() {
  float here = logDepth(uv2);
  if (here > 999.0) discard;
  float behind = 0.0;
  for (int i = 0; i < 8; i++) {
    float angle = float(i) * 0.7853982;
    float there = logDepth(uv2 + vec2(cos(angle), sin(angle)) * pixel * 1.4);
    behind += there > 999.0 ? 0.0 : max(0.0, here - there);
  }
  // never black: in sparse places every other point lies far behind its neighbors
  color = vec4(texture(picture, uv2).rgb * (0.45 + 0.55 * exp(-behind * strength)), 1.0);
  gl_FragDepth = texture(depth, uv2).r;
}`;

export function screenMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: SCREEN_VERTEX,
    fragmentShader: SCREEN_FRAGMENT,
    uniforms: {
      picture: { value: null }, depth: { value: null }, pixel: { value: new Vector2() },
      nearFar: { value: new Vector2(0.1, 1000) }, strength: { value: 3 },
    },
  });
}

const LINE_VERTEX = /* glsl */ `
in vec3 rough;
in vec3 tint;
uniform float toRough;
out vec3 shade;
void main() {
  shade = tint;
  gl_PointSize = 11.0; // of marks; lines have none
  gl_Position = projectionMatrix * modelViewMatrix * vec4(mix(position, rough, toRough), 1.0);
}`;

/** Lines whose points have a refined place (position) and a rough one. */
export function lineMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: LINE_VERTEX,
    fragmentShader: "precision highp float; in vec3 shade; out vec4 color; void main() { color = vec4(shade, 1.0); }",
    uniforms: { toRough: { value: 0 } },
  });
}

/** Points like the lines of `lineMaterial`, with a ring that sets them off from what lies behind. */
export function markMaterial(): ShaderMaterial {
  return new ShaderMaterial({
    glslVersion: GLSL3,
    vertexShader: LINE_VERTEX,
    fragmentShader: `precision highp float; in vec3 shade; out vec4 color;
void main() {
  float away = length(gl_PointCoord - 0.5);
  if (away > 0.5) discard;
  color = vec4(away > 0.42 ? vec3(0.0) : away > 0.3 ? vec3(1.0) : shade, 1.0);
}`,
    uniforms: { toRough: { value: 0 } },
  });
}

function nearest(texture: DataTexture): DataTexture {
  texture.minFilter = NearestFilter;
  texture.magFilter = NearestFilter;
  texture.needsUpdate = true;
  return texture;
}

export function nodesTexture(entries: Uint32Array<ArrayBuffer>): DataTexture {
  const texture = new DataTexture(entries, NODES_WIDTH, entries.length / 2 / NODES_WIDTH, RGIntegerFormat, UnsignedIntType);
  texture.internalFormat = "RG32UI";
  return nearest(texture);
}

export function scansTexture(rows: Float32Array<ArrayBuffer>): DataTexture {
  return nearest(new DataTexture(rows, SCANS_WIDTH, rows.length / 4 / SCANS_WIDTH, RGBAFormat, FloatType));
}

export function paletteTexture(colors: Uint8Array<ArrayBuffer>): DataTexture {
  return nearest(new DataTexture(colors, 256, 1, RGBAFormat, UnsignedByteType));
}
